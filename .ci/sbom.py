"""A software bill of materials of the installed program, CycloneDX 1.5 JSON, on standard output.

The packages are those that the project needs with its extras `live`, `plan` and `cluster`, and what
these need in turn.
"""

import json
import re
import sys
from importlib import metadata

EXTRAS = ("live", "plan", "cluster")


def needed(name="skyquilt", extras=EXTRAS):
    """Distributions by plain name, each with the names of those it needs."""
    from packaging.requirements import Requirement

    found, waiting = {}, [(name, extras)]
    while waiting:
        name, extras = waiting.pop()
        one = metadata.distribution(name)
        names = []
        for line in one.requires or []:
            wanted = Requirement(line)
            if wanted.marker and not any(
                wanted.marker.evaluate({"extra": e}) for e in ("", *extras)
            ):
                continue
            names.append(plain(wanted.name))
            if plain(wanted.name) not in found:
                waiting.append((wanted.name, tuple(wanted.extras)))
        found[plain(name)] = (one, sorted(set(names)))
    return dict(sorted(found.items()))


def plain(name):
    """A name as package indexes compare them."""
    return re.sub(r"[-_.]+", "-", name).lower()


def licence(one):
    """The licence that a distribution states."""
    about = one.metadata
    said = about.get("License-Expression") or ""
    kinds = [c.split(" :: ")[-1] for c in about.get_all("Classifier") or [] if "License ::" in c]
    free = (about.get("License") or "").strip().split("\n")[0]
    return said or (free if 0 < len(free) < 40 else "") or " AND ".join(kinds)


def bill():
    """The document."""
    found = needed()
    main, _ = found.pop("skyquilt")

    def reference(name, one):
        return f"pkg:pypi/{name}@{one.version}"

    every = {"skyquilt": main, **{name: one for name, (one, _) in found.items()}}
    tree = {"skyquilt": needed()["skyquilt"][1], **{n: more for n, (_, more) in found.items()}}
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {
            "component": {
                "type": "application",
                "bom-ref": reference("skyquilt", main),
                "name": "skyquilt",
                "version": main.version,
                "licenses": [{"expression": "Apache-2.0"}],
            }
        },
        "components": [
            {
                "type": "library",
                "bom-ref": reference(name, one),
                "name": name,
                "version": one.version,
                "purl": reference(name, one),
                "licenses": [{"license": {"name": licence(one)}}],
            }
            for name, (one, _) in found.items()
        ],
        "dependencies": [
            {
                "ref": reference(name, every[name]),
                "dependsOn": [reference(n, every[n]) for n in more],
            }
            for name, more in tree.items()
        ],
    }


if __name__ == "__main__":
    json.dump(bill(), sys.stdout, indent=1)
