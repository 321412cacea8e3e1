"""Build hook: compiles the shipped FMUs and the native loop, for wheels and for editable installs."""

from __future__ import annotations

import platform
import sys
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

# The source tree is not installed yet.
sys.path.insert(0, str(Path(__file__).resolve().parent))

from fmus import build, description

ZIGLANG = "ziglang>=0.13,<0.18"


class NativeBuildHook(BuildHookInterface[Any]):
    """Runs `fmus.build` and tags the wheel for this platform."""

    def dependencies(self) -> list[str]:
        """`ziglang`, 100 MB, only where there is no C compiler."""
        return [] if build.find_compiler() else [ZIGLANG]

    def initialize(
        self,
        version: str,  # noqa: ARG002 - the interface's
        build_data: dict[str, Any],
    ) -> None:
        """Compile for wheels, `version` "standard" and "editable"; a source distribution needs no binaries."""
        if self.target_name != "wheel":
            return
        try:
            for artifact in build.build_all():
                self.app.display_info(f"built {artifact.name}")
        except (build.BuildError, description.DescriptionError) as error:
            self.app.abort(f"netcosim could not be built: {error}")
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{_platform_tag()}"


def _platform_tag() -> str:
    """This platform's wheel tag. The binaries are of one architecture, even under a universal Python on macOS."""
    tag = sysconfig.get_platform().replace("-", "_").replace(".", "_")
    return tag.replace("universal2", platform.machine())
