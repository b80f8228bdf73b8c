"""Control points that are marked in the browser: checked, stored, written as `gcp_list.txt`."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from skyquilt.errors import SideFileError
from skyquilt.outside import plain, read_bounded, real, text_of
from skyquilt.photos.gcp import read_gcp_list
from skyquilt.photos.side_rows import read_crs
from skyquilt.raster.atomic import mended, write_text

FOLDER, STORED, LIST = "control", "control.json", "gcp_list.txt"
"""Folder in that of the run, what is marked, and the list that `--gcp` reads."""
MOST_POINTS, MOST_MARKS, MOST_NAME = 500, 10_000, 60
MOST_BYTES = 4_000_000
Control = dict[str, Any]
"""`crs`, `points` (name, x, y, z or null, check) and `marks` (point, photo, x, y)."""


def checked(data: Mapping[str, Any], photos: set[str]) -> Control:
    """What a client sent, with nothing else in it.

    Raises:
        SideFileError: it is not a list of control points for these photos.
    """
    try:
        crs = str(data["crs"])
        read_crs(crs, file="the list")
        points, marks = list(data["points"]), list(data["marks"])
        if len(points) > MOST_POINTS or len(marks) > MOST_MARKS:
            raise SideFileError(f"at most {MOST_POINTS} points and {MOST_MARKS} marks are taken")
        kept = [_point(p) for p in points]
        names = {p["name"] for p in kept}
        if len(names) < len(kept):
            raise SideFileError("two points have one name; rename one of them")
        return {"crs": crs, "points": kept, "marks": [_mark(m, names, photos) for m in marks]}
    except (KeyError, TypeError, AttributeError) as error:
        raise SideFileError(f"this is not a list of control points ({error})") from error


def _point(said: Mapping[str, Any]) -> dict[str, Any]:
    name = "".join(str(said["name"]).split())[:MOST_NAME]
    x, y = (real(said[k], -1e8, 1e8) for k in "xy")
    z = None if said.get("z") in (None, "") else real(said["z"], -12_000, 100_000)
    if not name or not name.isprintable() or x is None or y is None:
        raise SideFileError(f"point {plain(name, 60)!r} needs a name and two coordinates")
    if z is None and said.get("z") not in (None, ""):
        raise SideFileError(f"the height of {plain(name, 60)} is no number")
    return {"name": name, "x": x, "y": y, "z": z, "check": bool(said.get("check"))}


def _mark(said: Mapping[str, Any], names: set[str], photos: set[str]) -> dict[str, Any]:
    point, photo = str(said["point"]), str(said["photo"])
    x, y = (real(said[k], -1.0, 1e6) for k in "xy")
    if point not in names or photo not in photos or x is None or y is None:
        raise SideFileError(f"a mark names point {plain(point, 40)!r} in {plain(photo, 80)!r}")
    return {"point": point, "photo": photo, "x": round(x, 3), "y": round(y, 3)}


def list_text(control: Control) -> str:
    """The marks in OpenDroneMap's format; a name with a blank cannot be written, and is refused
    where points are checked. Names of photos may hold blanks: columns are separated by tabs.
    """
    points = {p["name"]: p for p in control["points"]}
    rows = [control["crs"]]
    for m in control["marks"]:
        p = points[m["point"]]
        z = "NaN" if p["z"] is None else repr(p["z"])
        words = [repr(p["x"]), repr(p["y"]), z, f"{m['x']:.3f}", f"{m['y']:.3f}", m["photo"]]
        rows.append("\t".join([*words, p["name"], *(["check"] if p["check"] else [])]))
    return "\n".join(rows) + "\n"


def store(folder: Path, control: Control) -> Path:
    """Stores points and marks beside a run, and the list of those that are marked; returns its
    path.

    Raises:
        OutputError: the folder cannot be written.
    """
    home = folder / FOLDER
    with mended(home):
        home.mkdir(exist_ok=True)
    write_text(home / STORED, json.dumps(control, indent=1))
    write_text(home / LIST, list_text(control))
    return home / LIST


def stored(folder: Path, photos: set[str]) -> Control | None:
    """What was marked before; None where there is nothing, or it is damaged."""
    try:
        return checked(json.loads(read_bounded(folder / FOLDER / STORED)), photos)
    except (OSError, ValueError, RecursionError, SideFileError):
        return None


def read_list(path: Path, photos: list[str], crs: str) -> Control:
    """A `gcp_list.txt`, or a CSV of points: name, x, y, z, and `check` for check points, in `crs`.

    Raises:
        SideFileError: it is neither.
    """
    text = text_of(read_bounded(path, MOST_BYTES))
    rows = [line.strip() for line in text.splitlines() if line.strip()[:1] not in ("", "#")]
    if rows and "," in rows[0] and rows[0].count(",") >= 2 and not rows[0].startswith("+"):
        return checked({"crs": crs, "points": _csv(rows), "marks": []}, set(photos))
    found, _ = read_gcp_list(path, photos)
    points = [{"name": p.name, "x": p.x, "y": p.y, "z": p.z, "check": p.check} for p in found]
    marks = [
        {"point": "".join(p.name.split()), "photo": o.photo, "x": o.x, "y": o.y}
        for p in found
        for o in p.observations
    ]
    system = found[0].crs if found else crs
    return checked({"crs": system, "points": points, "marks": marks}, set(photos))


def _csv(rows: list[str]) -> list[dict[str, Any]]:
    points = []
    for k, row in enumerate(rows):
        words = [w.strip().strip('"') for w in row.split(",")]
        if k == 0 and (len(words) < 3 or real(words[1]) is None):
            continue  # the names of the columns
        if len(words) < 3:
            raise SideFileError(f"line {k + 1}: expected name, x, y, z, found '{plain(row, 100)}'")
        check = words[0].lower().startswith("check") or "check" in (w.lower() for w in words[4:5])
        z = words[3] if len(words) > 3 and words[3].lower() != "nan" else None
        points.append({"name": words[0], "x": words[1], "y": words[2], "z": z, "check": check})
    return points
