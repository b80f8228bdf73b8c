"""Endpoints of photos: all photos, those that cover a point, one photo, its file."""

from typing import Annotated, Any

from fastapi import HTTPException, Query
from fastapi.responses import FileResponse

from skyquilt.server.access import Context
from skyquilt.server.survey import Shown, covering

Degrees = Annotated[float, Query(ge=-180, le=180)]


class PhotoEndpoints:
    """Endpoints of photos."""

    def __init__(self, context: Context) -> None:
        self.context = context

    def photos(
        self, lon: Degrees | None = None, lat: Annotated[float | None, Query(ge=-90, le=90)] = None
    ) -> dict[str, Any]:
        """All photos; with `lon` and `lat` in degrees those that cover the point, the most vertical
        first.
        """
        everything = self.context.survey.photos()
        if lon is not None and lat is not None:
            return {"photos": [p.record for p in covering(everything, lon, lat)]}
        refused = self.context.survey.refused() if hasattr(self.context.survey, "refused") else []
        return {"photos": [p.record for p in everything], "refused": refused}

    def photo(self, number: int) -> dict[str, Any]:
        """One photo."""
        return dict(self._known(number).record)

    def _known(self, number: int) -> Shown:
        found = self.context.survey.photo(number)
        if found is None:
            raise HTTPException(404, f"there is no photo {number}")
        return found

    def photo_file(self, number: int) -> FileResponse:
        """A photo at full resolution, as it was sent."""
        found = self._known(number)
        if found.path is None or not found.path.is_file():
            raise HTTPException(404, "its file no longer exists")
        kind = {".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".png": "image/png"}.get(
            found.path.suffix.lower(), "image/tiff"
        )
        return FileResponse(found.path, media_type=kind, headers={"Content-Disposition": "inline"})
