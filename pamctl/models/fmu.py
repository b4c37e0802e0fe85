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
from tempfile import TemporaryDirectory
from typing import NamedTuple
from xml.etree import ElementTree as Xml

from pamctl import __version__
from pamctl.exit_codes import ExitCode
from pamctl.kernel.build import CannotBuild, compile_library, require_compiler
from pamctl.kernel.c_source import FLOAT, INT, NUMBERS, CSource, CType, Kernel, write_call
from pamctl.new_file import create_new_file, require_place
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
SOURCES = ("fmi3_interface.c",)
"""What is compiled; it includes plant.c."""


class Variable(NamedTuple):
    """A variable of the unit; its value reference is its place in `VARIABLES`."""

    name: str
    causality: str
    unit: str
    meaning: str


VARIABLES = (
    Variable("time", "independent", "s", "time"),
    Variable("command_v", "input", "V", "valve command, -5 to 5 V, positive fills; held in a step"),
    Variable("position_m", "output", "m", "displacement as the encoder shows it, without steps"),
    Variable("pressure_pa", "output", "Pa", "absolute pressure as the sensor shows it, no noise"),
    Variable("true_position_m", "output", "m", "displacement"),
    Variable("velocity_m_per_s", "output", "m/s", "velocity of the displacement"),
    Variable("true_pressure_pa", "output", "Pa", "absolute pressure in the muscle"),
)
_UNITS = {
    "s": {"s": "1"},
    "m": {"m": "1"},
    "m/s": {"m": "1", "s": "-1"},
    "Pa": {"kg": "1", "m": "-1", "s": "-2"},
    "V": {"kg": "1", "m": "2", "s": "-3", "A": "-1"},
}
PERIOD_S = 1e-3


def describe_model(token: str, numbers: Mapping[str, float], description: str) -> bytes:
    """Return modelDescription.xml; `numbers` are the plant file's, listed as constants."""
    root = Xml.Element(
        "fmiModelDescription",
        fmiVersion="3.0",
        modelName=MODEL,
        instantiationToken=token,
        description=description,
        version=__version__,
        generationTool=f"pamctl {__version__}",
        variableNamingConvention="structured",
    )
    Xml.SubElement(
        root,
        "CoSimulation",
        modelIdentifier=MODEL,
        canHandleVariableCommunicationStepSize="true",
        canGetAndSetFMUState="true",
        canSerializeFMUState="true",
        providesIntermediateUpdate="false",
    )
    units = Xml.SubElement(root, "UnitDefinitions")
    for unit, base in _UNITS.items():
        Xml.SubElement(Xml.SubElement(units, "Unit", name=unit), "BaseUnit", base)
    categories = Xml.SubElement(root, "LogCategories")
    Xml.SubElement(categories, "Category", name="logStatusError")
    Xml.SubElement(root, "DefaultExperiment", startTime="0", stopTime="20", stepSize=repr(PERIOD_S))
    _list_variables(Xml.SubElement(root, "ModelVariables"), numbers)
    structure = Xml.SubElement(root, "ModelStructure")
    outputs = [str(i) for i, variable in enumerate(VARIABLES) if variable.causality == "output"]
    for kind in ("Output", "InitialUnknown"):
        for reference in outputs:
            Xml.SubElement(structure, kind, valueReference=reference)
    return _write(root)


def _list_variables(parent: Xml.Element, numbers: Mapping[str, float]) -> None:
    for reference, variable in enumerate(VARIABLES):
        attributes = {
            "name": variable.name,
            "valueReference": str(reference),
            "causality": variable.causality,
            "variability": "continuous",
            "unit": variable.unit,
            "description": variable.meaning,
        }
        if variable.causality == "input":
            attributes["start"] = "0"
        elif variable.causality == "output":
            attributes["initial"] = "calculated"
        Xml.SubElement(parent, "Float64", attributes)
    for index, (name, value) in enumerate(numbers.items()):
        Xml.SubElement(
            parent,
            "Float64",
            name=f"plant.{name}",
            valueReference=str(FIRST_NUMBER + index),
            causality="local",
            variability="constant",
            initial="exact",
            start=repr(float(value)),
        )


def describe_build() -> bytes:
    """Return buildDescription.xml, for importers that compile the sources themselves."""
    root = Xml.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = Xml.SubElement(root, "BuildConfiguration", modelIdentifier=MODEL)
    files = Xml.SubElement(configuration, "SourceFileSet", language="C99")
    for name in SOURCES:
        Xml.SubElement(files, "SourceFile", name=name)
    return _write(root)


def _write(root: Xml.Element) -> bytes:
    Xml.indent(root)
    content: bytes = Xml.tostring(root, encoding="UTF-8", xml_declaration=True)
    return content + b"\n"


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
