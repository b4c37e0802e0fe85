"""modelDescription.xml and buildDescription.xml of FMI 3.0."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple
from xml.etree import ElementTree as Xml

from pamctl import __version__
from pamctl.fmu.plant_source import FIRST_NUMBER

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
