"""Write the software bill of materials of this installation: CycloneDX 1.6, as JSON.

    python bench/sbom.py semviz.cdx.json

It lists semviz and every installed distribution that it needs, with the extras that are there:
versions, licences, hashes of the recorded files, and what needs what. It is made from the installed
metadata alone; the same installation gives the same bytes.
"""

import hashlib
import json
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name


def main(path: Path) -> None:
    found = installed("semviz")
    components = [component(found[name]) for name in sorted(found)]
    (root,) = (entry for entry in components if entry["name"] == "semviz")
    document = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {"component": root | {"type": "application"}},
        "components": [entry for entry in components if entry is not root],
        "dependencies": [
            {
                "ref": reference(found[name]),
                "dependsOn": sorted(
                    reference(found[need]) for need in needs(found[name]) & {*found}
                ),
            }
            for name in sorted(found)
        ],
    }
    path.write_text(json.dumps(document, indent=1) + "\n", "utf-8")
    print(f"{path}: {len(components)} distributions")


def installed(root: str) -> dict[str, metadata.Distribution]:
    """Return ``root`` and the installed distributions that it needs, by canonical name."""
    found: dict[str, metadata.Distribution] = {}
    pending = [root]
    while pending:
        name = canonicalize_name(pending.pop())
        if name in found:
            continue
        try:
            found[name] = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            continue  # of an extra, or of another platform
        pending += needs(found[name])
    return found


def needs(distribution: metadata.Distribution) -> set[str]:
    """Return the canonical names of its requirements, those of extras among them."""
    extras = ["", *(distribution.metadata.get_all("Provides-Extra") or [])]
    requirements = [Requirement(text) for text in distribution.requires or []]
    return {
        canonicalize_name(need.name)
        for need in requirements
        if need.marker is None or any(need.marker.evaluate({"extra": extra}) for extra in extras)
    }


def component(distribution: metadata.Distribution) -> dict[str, Any]:
    about = distribution.metadata
    licence = about.get("License-Expression") or about.get("License") or ""
    entry: dict[str, Any] = {
        "type": "library",
        "bom-ref": reference(distribution),
        "name": canonicalize_name(about["Name"]),
        "version": distribution.version,
        "purl": reference(distribution),
        "properties": [{"name": "semviz:record-sha256", "value": record_hash(distribution)}],
    }
    if licence and len(licence) < 100:
        entry["licenses"] = [{"license": {"name": " ".join(licence.split())}}]
    return entry


def record_hash(distribution: metadata.Distribution) -> str:
    """Return the hash of the list of its files with theirs, as pip recorded it."""
    return hashlib.sha256((distribution.read_text("RECORD") or "").encode()).hexdigest()


def reference(distribution: metadata.Distribution) -> str:
    return f"pkg:pypi/{canonicalize_name(distribution.metadata['Name'])}@{distribution.version}"


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "semviz.cdx.json"))
