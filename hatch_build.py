"""Put a software bill of materials into each wheel: ``.dist-info/sboms/semviz.cdx.json`` (PEP 770).

CycloneDX 1.6: what the wheel is, the weights that it ships, and the libraries that it needs, with
the versions that it allows. It has no time and no random number: the same sources give the same
bytes. ``bench/sbom.py`` lists an installation instead, with the versions that are installed.
"""

import hashlib
import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

NAME = "semviz.cdx.json"


class SbomHook(BuildHookInterface):
    """hatchling calls it around each build of a wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Write the file, and name it to hatchling."""
        self.folder = TemporaryDirectory()
        path = Path(self.folder.name, NAME)
        path.write_text(json.dumps(self.bill(), indent=1) + "\n", "utf-8")
        build_data["sbom_files"].append(str(path))

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the file: it is in the wheel."""
        self.folder.cleanup()

    def bill(self) -> dict[str, Any]:
        """Return the bill of materials."""
        core = self.metadata.core
        product = f"pkg:pypi/{canonicalize_name(core.name)}@{self.metadata.version}"
        libraries = libraries_of(core.dependencies, core.optional_dependencies)
        weights = [shipped(path) for path in sorted(Path(self.root).glob("core/*/weights/*.safe*"))]
        needs = {"ref": product, "dependsOn": [library["bom-ref"] for library in libraries]}
        return {
            "bomFormat": "CycloneDX",
            "specVersion": "1.6",
            "version": 1,
            "metadata": {
                "component": {
                    "type": "application",
                    "bom-ref": product,
                    "name": core.name,
                    "version": self.metadata.version,
                    "description": core.description,
                    "licenses": [{"expression": core.license_expression}],
                    "purl": product,
                }
            },
            "components": [*weights, *libraries],
            "dependencies": [needs],
        }


def libraries_of(plain: list[str], extras: dict[str, list[str]]) -> list[dict[str, Any]]:
    """Return a component for each library that is needed, always or by an extra."""
    wanted: dict[str, list[tuple[str, Requirement]]] = {}
    for extra, texts in (("", plain), *sorted(extras.items())):
        for requirement in map(Requirement, texts):
            name = canonicalize_name(requirement.name)
            if name != "semviz":  # an extra of several extras
                wanted.setdefault(name, []).append((extra, requirement))
    return [
        {
            "type": "library",
            "bom-ref": f"pkg:pypi/{name}",
            "name": name,
            "scope": "required" if any(not extra for extra, _ in uses) else "optional",
            "purl": f"pkg:pypi/{name}",
            "properties": [
                {"name": f"semviz:{extra or 'needed'}", "value": str(need.specifier)}
                for extra, need in uses
            ],
        }
        for name, uses in sorted(wanted.items())
    ]


def shipped(path: Path) -> dict[str, Any]:
    """Return the component of a network's weights."""
    content = path.read_bytes()
    return {
        "type": "machine-learning-model",
        "bom-ref": f"weights/{path.name}",
        "name": path.stem,
        "hashes": [{"alg": "SHA-256", "content": hashlib.sha256(content).hexdigest()}],
    }
