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
from collections.abc import Mapping
from pathlib import Path
from string import Template
from tempfile import TemporaryDirectory

from pamctl import __version__
from pamctl.base.errors import ExitCode
from pamctl.base.new_file import create_new_file, require_place
from pamctl.kernel.build import CannotBuild, compile_library, require_compiler
from pamctl.kernel.c_source import FLOAT, INT, NUMBERS, CSource, CType, Kernel, write_call
from pamctl.plant.model import PlantSettings, plant_parameters, values_of
from pamctl.plant.parameters import PlantParameters, vented_state
from pamctl.plant.simulated import LONGEST_STEP_S, advance_delayed_plant
from pamctl.plant.step import advance_plant, sensed_position_m, sensed_pressure_pa
from pamctl.settings.resolve import settings_to_yaml

FIRST_NUMBER = 100
"""Value reference of the first number of the plant file."""


def write_plant_source(p: PlantParameters, numbers: Mapping[str, float]) -> str:
    """Return plant.c: from the vented muscle at rest; `numbers` are shown, not used.

    Raise NotInC if a kernel, as that of an outside package's effect, cannot be written as C.
    """
    source = CSource()
    parameters = source.add_constant("parameters", p)
    start = source.add_constant("start", vented_state(p))
    is_delayed = p.effects.timing.command_delay.delay_s > 0.0

    def add(head: str, kernel: Kernel, given: Mapping[str, CType]) -> str:
        """Add a function with this head that calls a kernel; return the type of its result."""
        name, result = source.add_kernel(kernel, [parameters, *given.values()])
        call = write_call(name, {"parameters": parameters, **given})
        source.functions.append(f"static {result.name} {head} {{ return {call}; }}\n")
        return result.name

    if is_delayed:
        advanced = add(
            "advance_plant(const PLANT *plant, Numbers written_s, Numbers written_v, "
            "long long arrived, double now_s, double duration_s)",
            advance_delayed_plant,
            {
                "*plant": start, "written_s": NUMBERS, "written_v": NUMBERS,
                "written_s.length": INT, "arrived": INT, "now_s": FLOAT, "duration_s": FLOAT,
                repr(LONGEST_STEP_S): FLOAT,
            },
        )  # fmt: skip
    else:
        advanced = add(
            "advance_plant(const PLANT *plant, double command_v, double duration_s)",
            advance_plant,
            {
                "*plant": start, "command_v": FLOAT, "duration_s": FLOAT,
                repr(LONGEST_STEP_S): FLOAT,
            },
        )  # fmt: skip
    add(
        "show_position_m(const PLANT *plant)",
        sensed_position_m,
        {
            "plant->position_m": FLOAT, "plant->sensors": start["sensors"],
            "plant->age_s": FLOAT,
        },
    )  # fmt: skip
    add(
        "show_pressure_pa(const PLANT *plant)",
        sensed_pressure_pa,
        {
            "plant->pressure_pa": FLOAT, "plant->air": start["air"],
            "plant->sensors": start["sensors"], "plant->age_s": FLOAT,
        },
    )  # fmt: skip
    defined = [
        f"#define PLANT {start.name}",
        f"#define ADVANCED {advanced}",
        *(["#define COMMAND_IS_DELAYED"] if is_delayed else []),
        f"#define FIRST_NUMBER {FIRST_NUMBER}",
        f"#define NUMBERS {len(numbers)}",
    ]
    shown = ", ".join(repr(float(value)) for value in numbers.values())
    table = f"static const double numbers[] = {{{shown}}};"
    return "\n".join([*defined, source.text(), table, ""])


MODEL = "pamctl_plant"
"""Name of the shared library, in every importer's menus too."""
_FOLDER = Path(__file__).parent
"""It has the unit's interface in C, and its XML files; `modelDescription.xml` is a template."""


def describe_model(token: str, numbers: Mapping[str, float], description: str) -> str:
    """Return modelDescription.xml; `numbers` are the plant file's, listed as constants."""
    constants = (
        f'    <Float64 name="plant.{name}" valueReference="{reference}" causality="local" '
        f'variability="constant" initial="exact" start="{float(value)!r}" />'
        for reference, (name, value) in enumerate(numbers.items(), FIRST_NUMBER)
    )
    return Template(_read("modelDescription.xml")).substitute(
        token=token, description=description, version=__version__, numbers="\n".join(constants)
    )


def _read(name: str) -> str:
    return (_FOLDER / name).read_text("utf-8")


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
    interface_c = _read("fmi3_interface.c")
    token = f"{{{hashlib.sha256((plant_c + interface_c).encode()).hexdigest()[:32]}}}"
    sources = {
        "fmi3_interface.c": interface_c,  # it includes the other
        "plant.c": f'#define TOKEN "{token}"\n{plant_c}',
    }
    description = f"pneumatic rig, plant file of pamctl (actuator: {settings.actuator})"
    files: dict[str, str | bytes] = {
        "modelDescription.xml": describe_model(token, numbers, description),
        "sources/buildDescription.xml": _read("buildDescription.xml"),
        **{f"sources/{name}": text for name, text in sources.items()},
        "resources/plant.yaml": settings_to_yaml(settings),
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


def _zip_files(files: Mapping[str, str | bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name, _DATE), content, zipfile.ZIP_DEFLATED)
    return stream.getvalue()
