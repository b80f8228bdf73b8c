"""Photos as they are handed in: in one piece, or in parts that survive a lost connection."""

from typing import Annotated, Any

from fastapi import HTTPException, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse

from skyquilt.errors import OutputError
from skyquilt.live.photo_intake import Accepted, Intake, shown_name
from skyquilt.server.context import Context
from skyquilt.server.uploads import Uploads


class UploadEndpoints:
    """Addresses of uploads."""

    def __init__(self, context: Context) -> None:
        self.context = context

    async def upload(
        self, request: Request, name: str = "photo", source: str = "upload"
    ) -> JSONResponse:
        """Takes a photo (the body). It answers when the photo is safe: 201, 200 for a duplicate,
        422 refused.
        """
        writer, uploads = self.context.writing(request)
        held = self._begun(uploads, name, source, self._length(request))
        try:
            size = await self._received(request, held.id, writer.intake.inbox.most_bytes)
            if "content-length" in request.headers and size != int(
                request.headers["content-length"]
            ):
                raise HTTPException(
                    400, "the connection was lost before the photo was whole; send it again"
                )
            return await run_in_threadpool(self._handed_in, writer.intake, held.id, name, source)
        finally:
            uploads.drop(held.id)

    def _length(self, request: Request) -> int:
        text = request.headers.get("content-length", "0")
        size = int(text) if text.isdigit() else 0
        assert self.context.writer is not None
        most = self.context.writer.intake.inbox.most_bytes
        if size > most:
            raise HTTPException(413, f"a photo may have {most} bytes, this one has {size}")
        return size

    def _begun(self, uploads: Uploads, name: str, source: str, size: int) -> Any:
        try:
            held = uploads.begin(shown_name(name), shown_name(source), size)
        except OSError as error:
            raise HTTPException(
                507, f"the server's disk cannot take it ({error.strerror}); send it again later"
            ) from error
        if held is None:
            raise HTTPException(
                429, "too many uploads are under way; wait for some to end", {"Retry-After": "5"}
            )
        return held

    async def _received(self, request: Request, number: str, most: int) -> int:
        assert self.context.uploads is not None
        size = 0
        try:
            with self.context.uploads.path(number).open("ab") as file:
                async for block in request.stream():
                    size += len(block)
                    if size > most:
                        raise HTTPException(
                            413, f"a photo may have {most} bytes, this one has more"
                        )
                    file.write(block)
        except OSError as error:
            raise HTTPException(
                507, f"the server's disk cannot take it ({error.strerror}); send it again later"
            ) from error
        return size

    def _handed_in(self, intake: Intake, number: str, name: str, source: str) -> JSONResponse:
        assert self.context.uploads is not None
        try:
            with self.context.uploads.path(number).open("rb") as file:
                done = intake.take(iter(lambda: file.read(1 << 20), b""), name, source)
        except OutputError as error:
            raise HTTPException(507, str(error)) from error
        if not isinstance(done, Accepted):
            return JSONResponse({"name": done.name, "state": "refused", "reason": done.reason}, 422)
        said = {
            "id": done.id,
            "name": done.name,
            "state": "duplicate" if done.duplicate else "received",
        }
        return JSONResponse(said, 200 if done.duplicate else 201)

    def upload_begin(
        self, request: Request, name: str, size: Annotated[int, Query(ge=1)], source: str = "upload"
    ) -> JSONResponse:
        """Begins a resumable upload of `size` bytes; its parts go to /photos/uploads/{id}."""
        writer, uploads = self.context.writing(request)
        if size > writer.intake.inbox.most_bytes:
            raise HTTPException(
                413, f"a photo may have {writer.intake.inbox.most_bytes} bytes, this one has {size}"
            )
        held = self._begun(uploads, name, source, size)
        return JSONResponse(
            {"id": held.id, "offset": 0}, 201, {"Location": f"/photos/uploads/{held.id}"}
        )

    def upload_state(self, request: Request, number: str) -> Response:
        """How far a resumable upload is: header `Upload-Offset`."""
        _, uploads = self.context.writing(request)
        held = uploads.get(number)
        if held is None:
            raise HTTPException(404, "there is no such upload")
        return Response(
            headers={"Upload-Offset": str(held.offset), "Upload-Length": str(held.size)}
        )

    async def upload_part(self, request: Request, number: str) -> JSONResponse:
        """Appends a part at header `Upload-Offset`; the last one makes it a photo."""
        writer, uploads = self.context.writing(request)
        held = uploads.get(number)
        if held is None:
            raise HTTPException(404, "there is no such upload")
        if request.headers.get("upload-offset") != str(held.offset):
            raise HTTPException(
                409, f"Upload-Offset is {held.offset} here", {"Upload-Offset": str(held.offset)}
            )
        offset = held.offset
        try:
            async for block in request.stream():
                if offset + len(block) > held.size:
                    raise HTTPException(413, f"the upload was announced with {held.size} bytes")
                offset = await run_in_threadpool(uploads.append, held, block) if block else offset
        except OSError as error:
            raise HTTPException(
                507, f"the server's disk is full ({error.strerror}); send the rest later"
            ) from error
        if offset < held.size:
            return JSONResponse(
                {"id": number, "offset": offset}, 200, {"Upload-Offset": str(offset)}
            )
        answer = await run_in_threadpool(
            self._handed_in, writer.intake, number, held.name, held.source
        )
        uploads.drop(number)
        return answer
