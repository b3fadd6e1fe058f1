"""Functions that robots and clients have run elsewhere: their declaration, and how their values travel.

A function is a Python function with annotations, declared by :func:`function`. Its signature is its schema. Arguments
and results are MessagePack (maps, lists, numbers, text, bytes); numpy arrays are an extension type with a ``.npy``
file in it. In JSON, bytes and arrays are base64. Nothing is pickled.
"""

from __future__ import annotations

import importlib.util
import inspect
import io
import math
import sys
from collections.abc import Callable, Iterable, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cached_property, partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_type_hints

import msgspec
from msgspec import Meta

from relay_protocol.errors import Invalid, NotFound, SwitchboardError
from relay_protocol.limits import KIB

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

F = TypeVar("F", bound=Callable[..., Any])

ENTRY_POINTS = "switchboard.functions"
"""Entry points of this group name modules with functions."""

ARRAY = 1
"""Number of MessagePack's extension type for arrays: a ``.npy`` file, version 1.0."""

RUN_SECONDS = 10.0
"""Default of the longest run."""

MEMORY_MIB = 1024
"""Default of the memory that a call may take beside that of its process, MiB."""

ATTEMPTS = 3
"""Most attempts to run a repeatable function whose worker has died."""

FAULTS = (msgspec.MsgspecError, ValueError, TypeError, OverflowError, RecursionError)
"""Errors of msgspec on values that it can't read or write."""

COUNTED_BYTES = 64 * KIB
JSON_VALUES = 200_000
"""Results of more bytes may have so many values in JSON; longer lists are for MessagePack and arrays."""

Jpeg = Annotated[bytes, Meta(extra_json_schema={"contentMediaType": "image/jpeg"})]
"""A picture as JPEG."""


class CallFailed(SwitchboardError):
    """A call has ended without a result.

    :ivar code: ``error`` raised by the function, ``timeout``, ``memory``, ``crashed``, ``invalid_result``,
        ``too_large``, ``deadline``, ``cancelled``, ``lost``
    """

    def __init__(self, code: str, words: str) -> None:
        super().__init__(words)
        self.code = code


# --- declaration ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FunctionSpec:
    """A declared function.

    :param call: the function itself
    :param repeatable: whether running it twice does no harm; then it is run again if its worker dies
    :param seconds: longest run
    :param memory_mib: memory that a call may take, MiB
    :param labels: what its worker must have, as ``{"GPU": 1}``
    """

    name: str
    version: int
    call: Callable[..., Any]
    repeatable: bool = False
    seconds: float = RUN_SECONDS
    memory_mib: int = MEMORY_MIB
    labels: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def _hints(self) -> dict[str, Any]:
        return get_type_hints(self.call, include_extras=True)

    @cached_property
    def arguments(self) -> type[msgspec.Struct]:
        """The parameters as a struct."""
        fields: list[Any] = []
        for each in inspect.signature(self.call).parameters.values():
            if each.kind not in (each.POSITIONAL_OR_KEYWORD, each.KEYWORD_ONLY):
                raise Invalid(f"function {self.name}: parameter '{each.name}' can't be given by name")
            if each.name not in self._hints:
                raise Invalid(f"function {self.name}: parameter '{each.name}' has no type")
            default = () if each.default is each.empty else (each.default,)
            fields.append((each.name, self._hints[each.name], *default))
        return msgspec.defstruct(self.name, fields, kw_only=True, forbid_unknown_fields=True)

    @property
    def result(self) -> Any:
        """The type of the result."""
        return self._hints.get("return", Any)

    def describe(self) -> FunctionDescription:
        """The function for other machines.

        :raises Invalid: its signature can't be sent
        """
        try:
            schema = msgspec.json.schema(self.arguments, schema_hook=_schema_of)
            result = msgspec.json.schema(self.result, schema_hook=_schema_of)
        except TypeError as error:
            raise Invalid(f"function {self.name}: {error}") from None
        return FunctionDescription(
            name=self.name,
            version=self.version,
            text=inspect.getdoc(self.call) or "",
            arguments=schema,
            result=result,
            repeatable=self.repeatable,
            seconds=self.seconds,
            memory_mib=self.memory_mib,
            labels=dict(self.labels),
        )

    def run(self, arguments: bytes) -> bytes:
        """Call it.

        :param arguments: MessagePack of a map
        :returns: MessagePack of the result
        :raises Invalid: the arguments don't fit the signature
        :raises CallFailed: the result does not fit the signature, or can't be sent
        """
        given = decode_value(arguments)
        try:
            # Bytes in JSON have come as base64, which msgspec reads where the type is bytes.
            values = msgspec.convert(given, self.arguments, dec_hook=_array_of)
        except FAULTS as error:
            raise Invalid(f"function {self.name}: {error}") from None
        value = self.call(**{name: getattr(values, name) for name in values.__struct_fields__})
        return self._encode_result(value)

    def _encode_result(self, value: Any) -> bytes:
        try:
            body = encode_value(value)
            msgspec.convert(decode_value(body), self.result, dec_hook=_array_of)
        except (*FAULTS, Invalid) as error:
            raise CallFailed(
                "invalid_result", f"function {self.name} returned what its signature does not say: {error}"
            ) from None
        return body


class FunctionDescription(msgspec.Struct, frozen=True, kw_only=True):
    """A function as workers describe it.

    :param text: its docstring
    :param arguments: JSON schema of the arguments
    :param result: JSON schema of the result
    :param repeatable: whether it is run again if its worker dies
    :param seconds: longest run
    :param memory_mib: memory that a call may take, MiB
    :param labels: what its worker must have
    """

    name: str
    version: int
    text: str
    arguments: dict[str, Any]
    result: dict[str, Any]
    repeatable: bool
    seconds: float
    memory_mib: int
    labels: dict[str, float]


_MARK = "__switchboard_function__"


def function(
    *,
    version: int = 1,
    name: str = "",
    repeatable: bool = False,
    seconds: float = RUN_SECONDS,
    memory_mib: int = MEMORY_MIB,
    labels: Mapping[str, float] | None = None,
) -> Callable[[F], F]:
    """Declare a function; see :class:`FunctionSpec`. It can still be called as usual."""

    def mark(call: F) -> F:
        spec = FunctionSpec(
            name or call.__name__, version, call, repeatable, seconds, memory_mib, dict(labels or {})
        )
        setattr(call, _MARK, spec)
        return call

    return mark


def spec_of(call: Callable[..., Any]) -> FunctionSpec | None:
    """The declaration of a function, if it has one."""
    found = getattr(call, _MARK, None)
    return found if isinstance(found, FunctionSpec) else None


class FunctionRegistry:
    """Declared functions by name and version.

    :ivar problems: modules that could not be loaded, with the reason
    """

    def __init__(self) -> None:
        self._by_name: dict[str, dict[int, FunctionSpec]] = {}
        self.problems: list[str] = []

    def add(self, *calls: Callable[..., Any]) -> None:
        """Add declared functions.

        :raises Invalid: a function is not declared, or its name or signature can't be used
        """
        for call in calls:
            spec = spec_of(call)
            if spec is None:
                raise Invalid(f"{call!r} is not declared; write @function() above it")
            if not is_function_name(spec.name):
                raise Invalid(
                    f"'{spec.name}' is no name of a function: a-z, 0-9 and _, at most 63 characters"
                )
            spec.describe()
            self._by_name.setdefault(spec.name, {})[spec.version] = spec

    def add_module(self, module: Any) -> None:
        """Add the declared functions of a module."""
        self.add(*(each for each in vars(module).values() if spec_of(each) is not None))

    def load(self, folder: Path | None = None) -> None:
        """Load all functions of this machine: those of entry points, and the files of a folder.

        A module that can't be loaded is one of :attr:`problems`.
        """
        for point in sorted(entry_points(group=ENTRY_POINTS), key=lambda each: each.name):
            self._load(point.value, point.load)
        for path in sorted(folder.glob("*.py")) if folder is not None else ():
            self._load(path.name, partial(_load_file, path))

    def _load(self, label: str, load: Callable[[], Any]) -> None:
        try:
            self.add_module(load())
        except Exception as error:
            self.problems.append(f"{label}: {type(error).__name__}: {error}")

    def find(self, name: str, version: int | None = None) -> FunctionSpec:
        """A function; without a version its newest.

        :raises NotFound: there is none
        """
        versions = self._by_name.get(name, {})
        found = versions.get(max(versions) if version is None else version) if versions else None
        if found is None:
            raise NotFound(no_function(name, version, versions))
        return found

    def describe(self) -> list[FunctionDescription]:
        """All functions and versions, by name."""
        return [
            self._by_name[name][version].describe()
            for name in sorted(self._by_name)
            for version in sorted(self._by_name[name])
        ]


def no_function(name: str, version: int | None, versions: Iterable[int]) -> str:
    """Why there is no such function."""
    there = ", ".join(map(str, sorted(versions)))
    if there:
        return f"function '{name}' has no version {version}; there are {there}"
    return f"there is no function '{name[:63]}'"


def is_function_name(name: str) -> bool:
    """Whether a text can be a function's name."""
    return (
        name.isascii() and name.isidentifier() and name == name.lower() and name[0] != "_" and len(name) < 64
    )


def _load_file(path: Path) -> Any:
    name = f"switchboard_functions_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


# --- progress ---------------------------------------------------------------------------------------------

Reporter = Callable[[float, str], None]

reporter: ContextVar[Reporter | None] = ContextVar("reporter", default=None)
"""Takes the progress of the call that runs in this context."""


def progress(done: float, text: str = "") -> None:
    """Report the progress of the running function.

    :param done: 0 to 1
    :param text: in words
    """
    report = reporter.get()
    if report is not None:
        report(min(1.0, max(0.0, done)), text)


# --- values -----------------------------------------------------------------------------------------------


def encode_value(value: Any) -> bytes:
    """A value as MessagePack.

    :raises TypeError: it has a type that can't be sent
    """
    return msgspec.msgpack.encode(value, enc_hook=_encode_other)


def decode_value(body: bytes) -> Any:
    """The value of MessagePack; arrays as numpy arrays.

    :raises Invalid: the bytes are no MessagePack, or have an array that can't be read
    """
    try:
        return msgspec.msgpack.decode(body, ext_hook=_decode_extension)
    except FAULTS as error:
        raise Invalid(f"this is no MessagePack: {error}") from None


def to_json(body: bytes) -> bytes:
    """MessagePack as JSON, with bytes and arrays as base64.

    :raises Invalid: the bytes are no MessagePack
    :raises CostlyResult: they have too many values
    """
    if len(body) > COUNTED_BYTES:
        _check_values(body)
    try:
        return msgspec.json.encode(msgspec.msgpack.decode(body, ext_hook=lambda code, data: bytes(data)))
    except FAULTS as error:
        raise Invalid(f"this is no MessagePack that JSON can hold: {error}") from None


class CostlyResult(Invalid):
    """A result has too many values for JSON."""

    code = "too_costly"


def _check_values(body: bytes) -> None:
    """Walk the heads of the values of MessagePack, up to the limit.

    :raises CostlyResult: there are more than :data:`JSON_VALUES`
    :raises Invalid: the bytes are no MessagePack
    """
    at, left = 0, 1
    try:
        for _ in range(JSON_VALUES):
            step, inside = _head_at(body, at)
            at, left = at + step, left - 1 + inside
            if left == 0:
                return
            if left > len(body):
                raise Invalid("this is no MessagePack: it ends too early")
    except IndexError:
        raise Invalid("this is no MessagePack: it ends too early") from None
    raise CostlyResult(
        f"the result has more than {JSON_VALUES} values, too many for JSON; ask for it with "
        "'Accept: application/msgpack', or have the function return an array"
    )


_WIDTHS = {0xC4: 1, 0xC5: 2, 0xC6: 4, 0xD9: 1, 0xDA: 2, 0xDB: 4, 0xC7: 1, 0xC8: 2, 0xC9: 4}
"""Bytes of the length of bytes, texts and extensions, by their first byte."""
_FIXED = {0xCA: 5, 0xCB: 9} | {0xCC + power: 1 + (1 << power % 4) for power in range(8)}
_FIXED |= {0xD4 + power: 2 + (1 << power) for power in range(5)}
"""Bytes of values of fixed size, by their first byte."""
_CONTAINERS = {0xDC: (2, 1), 0xDD: (4, 1), 0xDE: (2, 2), 0xDF: (4, 2)}
"""Bytes of the length, and values per entry, of lists and maps."""


def _head_at(body: bytes, at: int) -> tuple[int, int]:
    """Bytes of the value up to its first part, and the number of its parts.

    :raises IndexError: the bytes end before
    """
    code = body[at]
    if code < 0x80 or code >= 0xE0:
        return 1, 0
    if code < 0x90:
        return 1, (code & 15) * 2
    if code < 0xA0:
        return 1, code & 15
    if code < 0xC0:
        return 1 + (code & 31), 0
    if code in _WIDTHS:
        width = _WIDTHS[code]
        type_byte = 1 if 0xC7 <= code <= 0xC9 else 0
        return 1 + width + type_byte + int.from_bytes(body[at + 1 : at + 1 + width], "big"), 0
    if code in _CONTAINERS:
        width, each = _CONTAINERS[code]
        return 1 + width, each * int.from_bytes(body[at + 1 : at + 1 + width], "big")
    return _FIXED.get(code, 1), 0


def _encode_other(value: Any) -> Any:
    if hasattr(value, "__array_interface__") and hasattr(value, "dtype"):
        return msgspec.msgpack.Ext(ARRAY, array_bytes(value)) if getattr(value, "ndim", 0) else value.item()
    raise TypeError(f"a value of the type {type(value).__name__} can't be sent")


def _decode_extension(code: int, data: memoryview) -> Any:
    if code != ARRAY:
        raise Invalid(f"there is no extension type {code}; arrays are {ARRAY}")
    return read_array(bytes(data))


def _array_of(kind: Any, value: Any) -> Any:
    """A value whose type is an array: from an array, or the bytes of one."""
    if hasattr(value, "__array_interface__"):
        return value
    if isinstance(value, str):
        value = msgspec.convert(value, bytes)
    if not isinstance(value, bytes):
        raise ValueError(f"expected an array (.npy), got {type(value).__name__}")
    return read_array(value)


def _schema_of(kind: Any) -> dict[str, Any]:
    import numpy as np

    if kind is np.ndarray or getattr(kind, "__origin__", None) is np.ndarray:
        return {"type": "string", "contentEncoding": "base64", "contentMediaType": "application/x-npy"}
    raise TypeError(
        f"a parameter or result has the type {getattr(kind, '__name__', kind)}, which can't be sent; use plain types, "
        "a msgspec.Struct or a numpy array"
    )


def array_bytes(array: npt.NDArray[Any]) -> bytes:
    """An array as a ``.npy`` file.

    :raises TypeError: it holds objects
    """
    import numpy as np

    target = io.BytesIO()
    try:
        np.lib.format.write_array(target, array, version=(1, 0), allow_pickle=False)
    except ValueError as error:
        raise TypeError(str(error)) from None
    return target.getvalue()


def read_array(data: bytes) -> npt.NDArray[Any]:
    """The array of a ``.npy`` file. Its header must announce just the bytes that are there.

    :raises Invalid: it is no such file
    """
    import numpy as np

    source = io.BytesIO(data)
    try:
        major, _ = np.lib.format.read_magic(source)
        read = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(source)
    except Exception as error:
        # numpy evaluates the header as a Python literal, which fails in many ways.
        raise Invalid(f"this is no .npy file: {error}") from None
    rest = memoryview(data)[source.tell() :]
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(rest):
        raise Invalid(f"this .npy file of {len(rest)} bytes can't be {shape} of {dtype}")
    try:
        array: np.ndarray[Any, Any] = np.frombuffer(rest, dtype=dtype)
        return array.reshape(shape, order="F" if fortran else "C")
    except (ValueError, TypeError, OverflowError) as error:
        raise Invalid(f"this .npy file can't be {shape} of {dtype}: {error}") from None
