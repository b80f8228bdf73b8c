"""Endpoints of photos: all photos, those that cover a point, one photo, its file."""

import hashlib
from pathlib import Path as FilePath
from typing import Annotated, Any

from fastapi import HTTPException, Path, Query
from fastapi.responses import FileResponse

from skyquilt.live.inbox import ending_of
from skyquilt.outside import open_regular
from skyquilt.photos.headers import HEAD_BYTES, content_digest
from skyquilt.server.access import Context
from skyquilt.server.shown import Shown, covering

Degrees = Annotated[float, Query(ge=-180, le=180, allow_inf_nan=False)]
Latitude = Annotated[float, Query(ge=-90, le=90, allow_inf_nan=False)]
Number = Annotated[int, Path(ge=0, le=2**53)]
"""The number of a photo."""
KEPT = 10_000
"""Number of files whose verification is remembered."""
_KINDS = {".jpg": "image/jpeg", ".tif": "image/tiff"}
"""Media types by ending where they are called otherwise."""


def _kind_of(found: Shown) -> str | None:
    assert found.path is not None
    with open_regular(found.path) as file:
        ending = ending_of(file.read(HEAD_BYTES))
        if ending is None:
            return None
        if content_digest(found.path) != found.digest:
            file.seek(0)
            whole = hashlib.blake2b(digest_size=16)  # live surveys name their photos by this
            while block := file.read(1 << 20):
                whole.update(block)
            if whole.hexdigest() != found.digest:
                return None
    return _KINDS.get(ending, f"image/{ending[1:]}")


class PhotoEndpoints:
    """Endpoints of photos."""

    def __init__(self, context: Context) -> None:
        self.context = context
        self._verdicts: dict[tuple[str, int, int, str], str | None] = {}

    def photos(self, lon: Degrees | None = None, lat: Latitude | None = None) -> dict[str, Any]:
        """All photos; with `lon` and `lat` in degrees those that cover the point, the most vertical
        first.
        """
        everything = self.context.survey.photos()
        if lon is not None and lat is not None:
            return {"photos": [p.record for p in covering(everything, lon, lat)]}
        refused = self.context.survey.refused() if hasattr(self.context.survey, "refused") else []
        return {"photos": [p.record for p in everything], "refused": refused}

    def photo(self, number: Number) -> dict[str, Any]:
        """One photo."""
        return dict(self._known(number).record)

    def _known(self, number: int) -> Shown:
        found = self.context.survey.photo(number)
        if found is None:
            raise HTTPException(404, f"there is no photo {number}")
        return found

    def photo_file(self, number: Number) -> FileResponse:
        """A photo at full resolution, as it was sent."""
        path, kind = self._file(number)
        return FileResponse(path, media_type=kind, headers={"Content-Disposition": "inline"})

    def checked(self, number: int) -> FilePath:
        """The file of a photo, if it is the one that the map was made from."""
        return self._file(number)[0]

    def _file(self, number: int) -> tuple[FilePath, str]:
        found = self._known(number)
        if found.path is None or not found.path.is_file():
            raise HTTPException(404, "its file no longer exists")
        kind = self._verified(found)
        if kind is None:
            raise HTTPException(404, "its file is not the photo that the map was made from")
        return found.path, kind

    def _verified(self, found: Shown) -> str | None:
        """The media type of a photo's file; None where it is no photo, or its content is not the
        one recorded with the map: a folder of unknown origin may name any file of this machine.
        """
        assert found.path is not None
        try:
            status = found.path.stat()
            key = (str(found.path), status.st_size, status.st_mtime_ns, found.digest)
            if key not in self._verdicts:
                while len(self._verdicts) >= KEPT:
                    self._verdicts.pop(next(iter(self._verdicts)))
                self._verdicts[key] = _kind_of(found)
            return self._verdicts[key]
        except OSError:
            return None
