"""Data schemas (W3C WoT Thing Description 1.1, section 5.3.2) of ROS messages as they are in JSON.

A schema describes what :mod:`relay_protocol.ros.cdr_to_json` writes: byte arrays are base64, NaN and infinity are
null. Units are UCUM codes, by REP 103 and the comments in the definitions of the types.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from relay_protocol.ros.definition import BYTES, Definition, Field, FieldType, Shape

Schema = dict[str, Any]

MAX_FIELDS = 300
"""Most fields in the schema of one message; further messages in it are objects without a description."""

MAX_CONSTANTS = 20

_BITS = {"int8": 8, "uint8": 8, "byte": 8, "char": 8, "int16": 16, "uint16": 16, "int32": 32, "uint32": 32}
_UNSIGNED = frozenset({"byte", "char", "uint8", "uint16", "uint32", "uint64"})

_MESSAGES: dict[str, dict[str, str]] = {
    "builtin_interfaces/Time": {"sec": "s", "nanosec": "ns"},
    "builtin_interfaces/Duration": {"sec": "s", "nanosec": "ns"},
    "geometry_msgs/Accel": {"linear": "m/s2", "angular": "rad/s2"},
    "geometry_msgs/Inertia": {"m": "kg", "com": "m"},
    "geometry_msgs/Point": {"x": "m", "y": "m", "z": "m"},
    "geometry_msgs/Point32": {"x": "m", "y": "m", "z": "m"},
    "geometry_msgs/Pose2D": {"x": "m", "y": "m", "theta": "rad"},
    "geometry_msgs/Transform": {"translation": "m"},
    "geometry_msgs/Twist": {"linear": "m/s", "angular": "rad/s"},
    "geometry_msgs/Wrench": {"force": "N", "torque": "N.m"},
    "nav_msgs/MapMetaData": {"resolution": "m"},
    "sensor_msgs/BatteryState": {
        "voltage": "V",
        "temperature": "Cel",
        "current": "A",
        "charge": "A.h",
        "capacity": "A.h",
        "design_capacity": "A.h",
        "percentage": "1",
        "cell_voltage": "V",
        "cell_temperature": "Cel",
    },
    "sensor_msgs/FluidPressure": {"fluid_pressure": "Pa"},
    "sensor_msgs/Illuminance": {"illuminance": "lx"},
    "sensor_msgs/Imu": {"angular_velocity": "rad/s", "linear_acceleration": "m/s2"},
    "sensor_msgs/LaserScan": {
        "angle_min": "rad",
        "angle_max": "rad",
        "angle_increment": "rad",
        "time_increment": "s",
        "scan_time": "s",
        "range_min": "m",
        "range_max": "m",
        "ranges": "m",
    },
    "sensor_msgs/MagneticField": {"magnetic_field": "T"},
    "sensor_msgs/NavSatFix": {"latitude": "deg", "longitude": "deg", "altitude": "m"},
    "sensor_msgs/Range": {
        "field_of_view": "rad",
        "min_range": "m",
        "max_range": "m",
        "range": "m",
        "variance": "m2",
    },
    "sensor_msgs/RelativeHumidity": {"relative_humidity": "1"},
    "sensor_msgs/Temperature": {"temperature": "Cel"},
}
UNITS = {name.replace("/", "/msg/"): fields for name, fields in _MESSAGES.items()}
"""Units of fields, by the full name of their message. That of a field that is a message holds for the numbers in it."""


def data_schema(definitions: Mapping[str, Definition], type_name: str, most: int = MAX_FIELDS) -> Schema:
    """The schema of a message.

    :param definitions: of the type and of all in it, by their full names
    :param type_name: full name of a message, or of a part of a service or action
    :param most: most fields that are described
    """
    return _SchemaMaker(definitions, most).message(type_name, "")


class _SchemaMaker:
    """Makes one schema.

    :param left: how many more fields may be described
    """

    def __init__(self, definitions: Mapping[str, Definition], left: int) -> None:
        self._definitions = definitions
        self._left = left

    def message(self, type_name: str, unit: str) -> Schema:
        """A message.

        :param unit: of the numbers in it, where the message itself has none
        """
        definition = self._definitions.get(type_name)
        if definition is None or len(definition.fields) > self._left:
            return {"type": "object", "description": type_name}
        self._left -= len(definition.fields)
        units = UNITS.get(type_name, {})
        return {
            "type": "object",
            "description": _description(definition),
            "properties": {
                each.name: self._field(each, units.get(each.name, unit)) for each in definition.fields
            },
        }

    def _field(self, field: Field, unit: str) -> Schema:
        kind = field.type
        if kind.shape is not Shape.SCALAR:
            return self._list(kind, unit)
        schema = self._one(kind, unit)
        if field.default is not None:
            schema["default"] = field.default
        return schema

    def _list(self, kind: FieldType, unit: str) -> Schema:
        if kind.base in BYTES:
            return {"type": "string", "contentEncoding": "base64"}
        schema: Schema = {"type": "array", "items": self._one(kind, unit)}
        if kind.length:
            schema["maxItems"] = kind.length
        if kind.shape is Shape.ARRAY:
            schema["minItems"] = kind.length
        return schema

    def _one(self, kind: FieldType, unit: str) -> Schema:
        primitive = kind.primitive
        if primitive is None:
            return self.message(kind.base, unit)
        if primitive.code == "?":
            return {"type": "boolean"}
        if not primitive.code:
            return {"type": "string", "maxLength": kind.bound} if kind.bound else {"type": "string"}
        schema = _number() if primitive.code in "fd" else _integer(kind.base)
        if unit:
            schema["unit"] = unit
        return schema


def _number() -> Schema:
    return {"oneOf": [{"type": "number"}, {"type": "null", "description": "NaN or infinity"}]}


def _integer(base: str) -> Schema:
    """Numbers of 64 bits have no largest value: JSON Schema compares in double precision."""
    schema: Schema = {"type": "integer"}
    bits, signed = _BITS.get(base), base not in _UNSIGNED
    if bits is not None:
        schema["minimum"] = -(2 ** (bits - 1)) if signed else 0
        schema["maximum"] = 2 ** (bits - signed) - 1
    elif not signed:
        schema["minimum"] = 0
    return schema


def _description(definition: Definition) -> str:
    constants = _listed(f"{each.name} = {each.value}" for each in definition.constants[:MAX_CONSTANTS])
    return f"{definition.name}. Constants: {constants}" if constants else definition.name


def _listed(parts: Iterable[str]) -> str:
    return ", ".join(parts)
