"""Write an FMU: the plant's kernels as C, compiled here, with their sources inside.

    plant file -> parameters -> plant.c -> shared library -> model.fmu (a zip)

The library is for this computer's system and processor. Other ones compile the sources that the
unit carries: `sources/buildDescription.xml` says how.
"""

from __future__ import annotations

import hashlib
import io
import platform
import sys
import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory

from pamctl.exit_codes import ExitCode
from pamctl.fmu.model_description import MODEL, SOURCES, describe_build, describe_model
from pamctl.fmu.plant_source import write_plant_source
from pamctl.kernel.build import CannotBuild, compile_library, require_compiler
from pamctl.new_file import create_new_file, require_place
from pamctl.plant.model import PlantSettings, plant_parameters, values_of
from pamctl.settings.resolve import settings_to_yaml

_SYSTEMS = {"linux": ("linux", "so"), "darwin": ("darwin", "dylib"), "win32": ("windows", "dll")}
_PROCESSORS = {"amd64": "x86_64", "arm64": "aarch64"}
_DATE = (1980, 1, 1, 0, 0, 0)
"""In the zip, so that the same plant gives the same bytes."""


class FmuError(Exception):
    """The plant cannot leave as an FMU. The message says why, and what to do."""

    def __init__(self, message: str, exit_code: ExitCode = ExitCode.USAGE) -> None:
        super().__init__(message)
        self.exit_code = exit_code


def write_fmu(settings: PlantSettings, destination: Path, *, sources_only: bool = False) -> str:
    """Write a new file; return the platform of its library, an empty text without one.

    Raise FmuError for a plant that cannot run so, or without a C compiler; NewFileError if the
    file cannot be written.
    """
    require_place(destination)
    if settings.actuator == "direct":
        raise FmuError(
            "`actuator: direct` is driven by a measured force, or by the measured pressure on its "
            "piston: a plant file has no chamber from which a valve command could make them, and "
            "an FMU has nothing to move it"
        )
    numbers = values_of(settings)
    plant_c = write_plant_source(plant_parameters(settings), numbers)
    interface_c = (Path(__file__).parent / SOURCES[0]).read_text("utf-8")
    token = f"{{{hashlib.sha256((plant_c + interface_c).encode()).hexdigest()[:32]}}}"
    sources = {
        SOURCES[0]: interface_c,
        "plant.c": f'#define TOKEN "{token}"\n{plant_c}',
    }
    description = f"pneumatic rig, plant file of pamctl (actuator: {settings.actuator})"
    files = {
        "modelDescription.xml": describe_model(token, numbers, description),
        "sources/buildDescription.xml": describe_build(),
        **{f"sources/{name}": text.encode() for name, text in sources.items()},
        "resources/plant.yaml": settings_to_yaml(settings).encode(),
    }
    place = ""
    if not sources_only:
        place, ending = _name_platform()
        files[f"binaries/{place}/{MODEL}.{ending}"] = _compile(sources, ending)
    with create_new_file(destination) as stream:
        stream.write(_zip_files(files))
    return place


def _name_platform() -> tuple[str, str]:
    """Return the platform's name in FMI 3.0, and the ending of its libraries."""
    system, ending = _SYSTEMS.get(sys.platform, (sys.platform, "so"))
    machine = platform.machine().lower()
    return f"{_PROCESSORS.get(machine, machine)}-{system}", ending


def _compile(sources: dict[str, str], ending: str) -> bytes:
    """Return the shared library."""
    with TemporaryDirectory() as folder:
        library = Path(folder, f"{MODEL}.{ending}")
        try:
            compile_library(require_compiler(), sources, library)
        except CannotBuild as error:
            raise FmuError(
                f"{error}; or give --sources-only for an importer that compiles the sources itself",
                ExitCode.UNAVAILABLE,
            ) from error
        return library.read_bytes()


def _zip_files(files: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name, _DATE), content, zipfile.ZIP_DEFLATED)
    return stream.getvalue()
