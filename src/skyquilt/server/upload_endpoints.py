"""Endpoints of photo uploads: in one request, or in parts that can be resumed after a lost
connection.

Parts follow the tus protocol for resumable uploads, version 1.0.0: its core, and its extensions
creation, expiration and termination. Beyond the protocol, the response to the last part reports the
result: the headers `Photo-Id` and `Photo-State`, or 422 with the reason if the photo is refused.
"""

import base64
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from email.utils import formatdate
from pathlib import Path
from typing import BinaryIO

from fastapi import HTTPException, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse
from starlette.requests import ClientDisconnect

from skyquilt.errors import OutputError
from skyquilt.live.inbox import belongs_to_clip
from skyquilt.live.photo_intake import Accepted, Intake, Refused, shown_name
from skyquilt.live.uploaded_clips import Waiting, bring_clip
from skyquilt.server.access import RESUMABLE, TUS, Context, blocks_of, client_of
from skyquilt.server.uploads import Upload, Uploads

VERSIONS = {"Tus-Version": "1.0.0"}
PART = "application/offset+octet-stream"
"""Media type of a part."""


class UploadEndpoints:
    """Endpoints of uploads."""

    def __init__(self, context: Context, folder: Path) -> None:
        self.context, self.uploads = context, Uploads(folder / "uploads", context.guard)

    # -- in one request

    async def upload(
        self, request: Request, name: str = "photo", source: str = "upload"
    ) -> JSONResponse:
        """Accepts a photo (the body). Responds when the photo is stored durably: 201, 200 for a
        duplicate, 422 if refused. A finished video, or a file of positions with its name: 202; its
        frames become photos later.
        """
        intake = self.context.writing(request).intake
        unread = await run_in_threadpool(intake.unread, name, source)
        if unread is not None:
            return _refusal(unread)
        most = intake.most_bytes(name)
        limit = f"such a file may have {most} bytes"
        _check_size(_length(request), most, limit)
        client = client_of(request)
        upload = await run_in_threadpool(self._begun, name, source, most, client)
        with self.uploads.writing(upload.id):
            try:
                await self._append(request, upload, limit)
                done = await run_in_threadpool(self._handed_in, intake, upload)
            finally:
                self.uploads.drop(upload.id)
        if isinstance(done, Refused):
            return _refusal(done)
        if isinstance(done, Waiting):
            return JSONResponse({"name": done.name, "state": _state(done)}, 202)
        said = {"id": done.id, "name": done.name, "state": _state(done)}
        said |= {"reason": done.kept} if done.kept else {}
        return JSONResponse(said, 200 if done.duplicate else 201)

    # -- in parts (tus)

    def upload_offer(self) -> Response:
        """Reports the supported tus version and extensions."""
        intake = self.context.growing().intake
        most = max(intake.inbox.most_bytes, intake.settings.most_clip_bytes)
        offered = {"Tus-Extension": "creation,expiration,termination", "Tus-Max-Size": str(most)}
        return Response(status_code=204, headers=VERSIONS | offered)

    def upload_begin(self, request: Request) -> Response:
        """Starts an upload of `Upload-Length` bytes; `Upload-Metadata` may contain `filename` and
        `source`. The header `Location` gives the URL for its parts.
        """
        intake = self._tus(request)
        size = _number(request, "upload-length")
        if size is None:
            raise HTTPException(400, "Upload-Length, the size of the photo in bytes, is needed")
        if size == 0:
            raise HTTPException(422, "an empty file is not a photo")
        metadata = request.headers.get("upload-metadata", "")
        about = metadata_of(metadata)
        name = about.get("filename") or about.get("name") or "photo"
        source = about.get("source") or "upload"
        unread = intake.unread(name, source)
        if unread is not None:
            return _refusal(unread)
        most = intake.most_bytes(name)
        _check_size(size, most, f"such a file may have {most} bytes", {"Tus-Max-Size": str(most)})
        upload = self._begun(name, source, size, client_of(request), metadata)
        at = f"{RESUMABLE}/{upload.id}"
        if self.context.guard.public_url:  # else clients find it on the host that they asked
            at = self.context.guard.base(request) + at.lstrip("/")
        told = {"Location": at, **self._progress(upload)}
        return Response(status_code=201, headers=told)

    async def upload_state(self, request: Request, number: str) -> Response:
        """Reports the progress of an upload: `Upload-Offset`."""
        intake, upload = self._tus(request), self._known(number)
        if self.uploads.offset(upload) == upload.size and not upload.outcome:
            # All bytes have arrived, but the server ended or its disk was full before the photo was
            # stored durably. The offset alone would tell the client that the photo is safe.
            with self._alone(number):
                answer = await self._finished(intake, upload)
            if answer.status_code != 204:
                return answer
            upload = self._known(number)
        told = self._progress(upload) | {"Upload-Length": str(upload.size)}
        if upload.metadata:
            told["Upload-Metadata"] = upload.metadata
        return Response(headers=told | {"Cache-Control": "no-store"})

    async def upload_part(self, request: Request, number: str) -> Response:
        """Appends a part at `Upload-Offset`; the last part completes the photo."""
        intake, upload = self._tus(request), self._known(number)
        if request.headers.get("content-type", "").split(";")[0].strip().lower() != PART:
            raise HTTPException(415, f"a part has the Content-Type {PART}")
        with self._alone(number):
            offset = self.uploads.offset(upload)
            if _number(request, "upload-offset") != offset:
                raise HTTPException(
                    409, f"Upload-Offset is {offset} here", {"Upload-Offset": str(offset)}
                )
            limit = f"the upload was announced with {upload.size} bytes"
            _check_size(offset + _length(request), upload.size, limit)
            if not upload.outcome:
                await self._append(request, upload, limit)
                if self.uploads.offset(upload) == upload.size:
                    return await self._finished(intake, upload)
        return Response(status_code=204, headers=self._progress(upload))

    async def upload_end(self, request: Request, number: str) -> Response:
        """Deletes an upload; a photo that was accepted is kept."""
        self._tus(request)
        self._known(number)
        with self._alone(number):
            self.uploads.drop(number)
        return Response(status_code=204)

    def _tus(self, request: Request) -> Intake:
        """The intake of photos, if the request may write and uses this version of tus."""
        writer = self.context.writing(request)
        if request.headers.get("tus-resumable") != TUS["Tus-Resumable"]:
            raise HTTPException(412, "this is tus 1.0.0; say so in Tus-Resumable", VERSIONS)
        return writer.intake

    def _known(self, number: str) -> Upload:
        upload = self.uploads.get(number)
        if upload is None:
            raise HTTPException(404, "there is no such upload, or it has expired")
        return upload

    @contextmanager
    def _alone(self, number: str) -> Iterator[None]:
        """Locks an upload while one request writes to it."""
        with self.uploads.writing(number) as mine:
            if not mine:
                raise HTTPException(409, "another request is writing this upload; try again later")
            yield

    def _progress(self, upload: Upload) -> dict[str, str]:
        """Headers with the progress of an upload."""
        told = {"Upload-Offset": str(self.uploads.offset(upload)), **upload.outcome}
        if not upload.outcome:
            told["Upload-Expires"] = formatdate(self.uploads.expires(upload), usegmt=True)
        return told

    async def _finished(self, intake: Intake, upload: Upload) -> Response:
        """Passes a complete upload to the intake of photos."""
        done = await run_in_threadpool(self._handed_in, intake, upload)
        if isinstance(done, Refused):
            self.uploads.drop(upload.id)
            return _refusal(done)
        told = {"Photo-Id": str(done.id)} if isinstance(done, Accepted) else {}
        told["Photo-State"] = _state(done)
        self.uploads.accept(upload, told)
        return Response(status_code=204, headers={"Upload-Offset": str(upload.size), **told})

    # -- both

    def _begun(self, name: str, source: str, size: int, client: str, metadata: str = "") -> Upload:
        try:
            upload = self.uploads.begin(
                shown_name(name), shown_name(source), size, client, metadata
            )
        except OSError as error:
            raise _no_room(error) from error
        if upload is None:
            raise HTTPException(
                429,
                "too many uploads are in progress; wait until some have ended",
                {"Retry-After": "5"},
            )
        return upload

    async def _append(self, request: Request, upload: Upload, limit: str) -> None:
        """Appends the body to an upload. If the connection is lost, the bytes that arrived are
        kept. If the body is too long or the disk is full, none of its bytes are kept.
        """
        path, before = self.uploads.path(upload), self.uploads.offset(upload)
        try:
            with path.open("ab") as file:
                whole = await self._written(request, file, upload.size, limit)
                file.flush()
                await run_in_threadpool(os.fsync, file.fileno())
        except OSError as error:
            _cut(path, before)
            raise _no_room(error) from error
        except HTTPException:
            _cut(path, before)
            raise
        if not whole:
            raise HTTPException(
                408, "the connection was lost before all bytes arrived; send the rest"
            )

    async def _written(self, request: Request, file: BinaryIO, most: int, limit: str) -> bool:
        """Writes the body to a file; False if the connection was lost before its end."""
        size = file.tell()
        try:
            async for block in blocks_of(request, self.context.guard.upload_stall_s):
                size += len(block)
                _check_size(size, most, limit)
                file.write(block)
        except (ClientDisconnect, TimeoutError):
            return False
        return True

    def _handed_in(self, intake: Intake, upload: Upload) -> Accepted | Refused | Waiting:
        try:
            if belongs_to_clip(upload.name):
                return bring_clip(intake, self.uploads.path(upload), upload.name, upload.source)
            with self.uploads.path(upload).open("rb") as file:
                blocks = iter(lambda: file.read(1 << 20), b"")
                return intake.take(blocks, upload.name, upload.source)
        except OutputError as error:
            raise HTTPException(507, str(error)) from error


def metadata_of(header: str) -> dict[str, str]:
    """Keys and values of `Upload-Metadata`: pairs with commas between them, each a key and, after a
    space, its value in Base64.

    Raises:
        HTTPException: 400, the header is invalid.
    """
    found: dict[str, str] = {}
    for pair in header.split(",") if header.strip() else []:
        key, _, value = pair.strip().partition(" ")
        try:
            text = base64.b64decode(value.strip(), validate=True).decode(errors="replace")
        except ValueError:
            raise HTTPException(400, f"Upload-Metadata: {key[:60]!r} is not Base64") from None
        if not key or key in found:
            raise HTTPException(400, "Upload-Metadata: each value needs a key of its own")
        found[key] = text
    return found


def _length(request: Request) -> int:
    """Number of bytes of the body as announced by the client; 0 if it was not announced."""
    return _number(request, "content-length") or 0


def _number(request: Request, header: str) -> int | None:
    """A header with a number of bytes; None if it is missing or invalid."""
    text = request.headers.get(header, "")
    return int(text) if re.fullmatch("[0-9]{1,18}", text) else None


def _check_size(size: int, most: int, limit: str, headers: dict[str, str] | None = None) -> None:
    if size > most:
        raise HTTPException(413, f"{limit}, this one has {size} or more", headers)


def _cut(path: Path, size: int) -> None:
    with suppress(OSError):
        os.truncate(path, size)


def _no_room(error: OSError) -> HTTPException:
    return HTTPException(507, f"the server cannot store it ({error.strerror}); send it again later")


def _state(done: Accepted | Waiting) -> str:
    if isinstance(done, Waiting):
        return "waiting"
    return "duplicate" if done.duplicate else "kept" if done.kept else "received"


def _refusal(done: Refused) -> JSONResponse:
    return JSONResponse({"name": done.name, "state": "refused", "reason": done.reason}, 422)
