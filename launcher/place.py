"""Paths of a checkout."""

import os
from dataclasses import dataclass, replace
from pathlib import Path


@dataclass(frozen=True)
class Place:
    """A checkout, its build and its logs."""

    source: Path
    build: Path
    logs: Path
    is_build_given: bool = False  # the caller keeps it up to date

    @classmethod
    def from_environment(cls):
        """Tests point BODYSCHEMA_BUILD and BODYSCHEMA_LOGS at their own build and at a folder of their own."""
        source = Path(__file__).resolve().parent.parent
        build = os.environ.get("BODYSCHEMA_BUILD")
        logs = os.environ.get("BODYSCHEMA_LOGS") or source / "logs"
        return cls(source, Path(build).absolute() if build else source / "build", Path(os.path.realpath(logs)), bool(build))

    def with_build(self, build):
        return replace(self, build=build)

    @property
    def bin(self):
        return self.build / "bin"

    @property
    def console(self):
        return self.bin / "bodyschema"

    @property
    def current(self):
        """Symbolic link to the newest run."""
        return self.logs / "current"
