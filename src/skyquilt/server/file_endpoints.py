"""Endpoints of the files of a finished map: the list, and each of them."""

from pathlib import Path
from typing import Any

from fastapi import HTTPException
from fastapi.responses import FileResponse

from skyquilt.engine.folder import EXPORTS, FILES
from skyquilt.outside import open_regular
from skyquilt.server.access import Context

REPORT = "report.html"
PAGE_POLICY = (
    "sandbox allow-scripts allow-popups; default-src 'none'; img-src data:;"
    " style-src 'unsafe-inline'; script-src 'unsafe-inline'"
)
"""For pages of a run: they may come from a stranger, so they act as a site of their own."""
SAVED = (".png", ".pgw", ".prj", ".xml", ".kmz", ".mbtiles", ".tif", ".gpkg")
"""Endings of exports."""
KINDS = {
    ".html": "text/html", ".tif": "image/tiff", ".json": "application/json", ".png": "image/png",
    ".geojson": "application/geo+json", ".kmz": "application/vnd.google-earth.kmz",
}  # fmt: skip


class FileEndpoints:
    """Endpoints of files."""

    def __init__(self, context: Context) -> None:
        self.context = context

    def _known(self) -> dict[str, tuple[Path, str]]:
        """Files that may be sent, by name, with a word for each."""
        folder = self.context.survey.results()
        if folder is None:
            return {}
        named = {REPORT: "report", **FILES}
        found = {n: (folder / n, words) for n, words in named.items() if (folder / n).is_file()}
        exports = folder / EXPORTS
        if exports.is_dir() and not exports.is_symlink():
            for path in sorted(exports.iterdir())[:200]:
                if path.suffix in SAVED and path.is_file() and not path.is_symlink():
                    found[f"{EXPORTS}/{path.name}"] = (path, "export")
        return found

    def files(self) -> dict[str, Any]:
        """Files of the finished map: name, what it is, size in bytes."""
        listed = [
            {"name": name, "what": words, "bytes": path.stat().st_size}
            for name, (path, words) in self._known().items()
        ]
        return {"files": listed}

    def file(self, name: str) -> FileResponse:
        """A file of the finished map; only those that are listed."""
        found = self._known().get(name)
        if found is None:
            raise HTTPException(404, "there is no such file")
        path = found[0]
        try:
            with open_regular(path):
                pass
        except OSError as error:
            raise HTTPException(404, "there is no such file") from error
        kind = KINDS.get(path.suffix, "application/octet-stream")
        if name == REPORT:
            headers = {"Content-Security-Policy": PAGE_POLICY, "Content-Disposition": "inline"}
            return FileResponse(path, media_type=kind, headers=headers)
        return FileResponse(path, media_type=kind, filename=path.name)
