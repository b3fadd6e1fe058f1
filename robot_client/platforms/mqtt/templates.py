"""The part of Home Assistant's Jinja templates that devices use, evaluated without running code.

Jinja parses a template. Its syntax tree is evaluated here, node by node; what is not in the tables below does not
exist: no attributes of Python objects, no loops, no macros, no powers. Steps and sizes are limited, so a template of
a hostile device ends after :data:`MAX_STEPS` cheap operations.
"""

from __future__ import annotations

import contextlib
import functools
import math
import re
from collections.abc import Callable, Mapping
from typing import Any

import jinja2
import msgspec
from jinja2 import nodes

from relay_protocol.errors import Invalid

MAX_TEMPLATE = 4096
"""Characters of a template."""

MAX_WORDS = 6000
"""Words and signs of the different templates of one message. To parse them takes about 20 µs each."""

MAX_STEPS = 300
MAX_TEXT = 64 * 1024
"""Characters of each text that a template makes."""

MAX_NUMBER = 2.0**53

_parser = jinja2.Environment(autoescape=False)  # noqa: S701  (no HTML is made; it only parses)


class TemplateError(Invalid):
    """A template that uses something that is not supported, or a value it can't be applied to."""


class MissingValue(TemplateError):
    """The payload has no such value; the state does not change."""


class _Undefined:
    """A value that a payload does not have."""

    def __init__(self, name: str) -> None:
        self.name = name


class Template:
    """A parsed template.

    :raises TemplateError: it is too long, is no Jinja, or uses something that is not supported
    """

    def __init__(self, source: str) -> None:
        if len(source) > MAX_TEMPLATE:
            raise TemplateError(f"the template has {len(source)} characters, more than {MAX_TEMPLATE}")
        self.source = source
        try:
            self._body = _parser.parse(source).body
        except jinja2.TemplateSyntaxError as error:
            raise TemplateError(f"the template {source[:80]!r} is not valid: {error.message}") from None
        except (RecursionError, ValueError, OverflowError, MemoryError):
            raise TemplateError(
                f"the template {source[:80]!r} is too deep or has too large numbers"
            ) from None
        _check_supported(self._body, source)

    def render(self, variables: Mapping[str, Any]) -> str:
        """The text for these variables.

        :raises MissingValue: a variable or a part of it that the template needs is not there
        :raises TemplateError: the template can't be applied to these values
        """
        evaluation = _Evaluation(dict(variables))
        try:
            return evaluation.render(self._body).strip()
        except TemplateError:
            raise
        except (ArithmeticError, LookupError, TypeError, ValueError, RecursionError) as error:
            name = type(error).__name__
            raise TemplateError(f"the template {self.source[:80]!r} failed: {name}") from None


class TemplateParser:
    """Parses the templates of one message: equal ones once, and at most :data:`MAX_WORDS` words and signs."""

    def __init__(self) -> None:
        self._parsed: dict[str, Template | TemplateError] = {}
        self._words_left = MAX_WORDS

    def parse(self, source: str) -> Template:
        """The parsed template.

        :raises TemplateError: as :class:`Template`, or the templates of the message have too many words
        """
        parsed = self._parsed.get(source)
        if parsed is None:
            try:
                parsed = self._parse(source)
            except TemplateError as error:
                parsed = error
            self._parsed[source] = parsed
        if isinstance(parsed, TemplateError):
            raise parsed
        return parsed

    def _parse(self, source: str) -> Template:
        if len(source) <= MAX_TEMPLATE:  # a longer one is refused before it is parsed
            words = len(_WORDS.findall(source))
            if words > self._words_left:
                raise TemplateError(
                    f"the templates of one discovery message may have {MAX_WORDS} words and signs together;"
                    f" {source[:80]!r} is left out"
                )
            self._words_left -= words
        return Template(source)


_WORDS = re.compile(r"\w+|[^\w\s]")


@functools.lru_cache(maxsize=1)
def value_variables(payload: str) -> Mapping[str, Any]:
    """The variables of a value template: ``value``, and ``value_json`` if the payload is JSON.

    All templates of one payload share the result.
    """
    variables: dict[str, Any] = {"value": payload}
    with contextlib.suppress(msgspec.DecodeError, UnicodeError, RecursionError):
        variables["value_json"] = msgspec.json.decode(payload)
    return variables


def text_of(value: Any) -> str:
    """A value as a template prints it: lists and objects as JSON, the rest as Python does."""
    if isinstance(value, _Undefined):
        raise MissingValue(f"the payload has no '{value.name}'")
    if isinstance(value, dict | list | tuple):
        text = msgspec.json.encode(value).decode()
    elif isinstance(value, float) and value.is_integer() and abs(value) >= MAX_NUMBER:
        text = f"{value:.17g}"
    else:
        text = str(value)
    if len(text) > MAX_TEXT:
        raise TemplateError(f"a template made a text of more than {MAX_TEXT} characters")
    return text


def _check_supported(body: list[nodes.Node], source: str) -> None:
    pending: list[nodes.Node] = list(body)
    while pending:
        node = pending.pop()
        name = type(node).__name__
        if name not in _EXPRESSIONS and name not in _STATEMENTS:
            raise TemplateError(f"the template {source[:80]!r} uses '{name}', which is not supported")
        if isinstance(node, nodes.Filter) and node.name not in _FILTERS:
            raise TemplateError(
                f"the template {source[:80]!r} uses the filter '{node.name}', which is not supported"
            )
        if isinstance(node, nodes.Test) and node.name not in _TESTS:
            raise TemplateError(
                f"the template {source[:80]!r} uses the test '{node.name}', which is not supported"
            )
        if isinstance(node, nodes.Call):
            _check_call(node, source)
        pending.extend(node.iter_child_nodes())


def _check_call(node: nodes.Call, source: str) -> None:
    called = node.node
    if isinstance(called, nodes.Getattr) and called.attr in _METHODS:
        return
    if isinstance(called, nodes.Name) and called.name in _FUNCTIONS:
        return
    name = getattr(called, "name", getattr(called, "attr", "?"))
    raise TemplateError(f"the template {source[:80]!r} calls '{name}', which is not supported")


class _Evaluation:
    """One evaluation of a template."""

    def __init__(self, variables: dict[str, Any]) -> None:
        self._variables = variables
        self._steps = 0

    def render(self, body: list[Any]) -> str:
        parts: list[str] = []
        size = 0
        for node in body:
            text = _STATEMENTS[type(node).__name__](self, node)
            size += len(text)
            if size > MAX_TEXT:
                raise TemplateError(f"a template made a text of more than {MAX_TEXT} characters")
            parts.append(text)
        return "".join(parts)

    def value(self, node: Any) -> Any:
        value = _bounded(_EXPRESSIONS[type(node).__name__](self, node))
        self._steps += 1 + (len(value) // 1000 if isinstance(value, str | list | dict) else 0)
        if self._steps > MAX_STEPS:
            raise TemplateError(f"the template needs more than {MAX_STEPS} steps")
        return value

    def arguments(self, node: Any) -> tuple[list[Any], dict[str, Any]]:
        """Positional and named arguments of a filter, a test or a call."""
        if node.dyn_args is not None or node.dyn_kwargs is not None:
            raise TemplateError("the template passes arguments with *, which is not supported")
        return [self.value(each) for each in node.args], {
            each.key: self.value(each.value) for each in node.kwargs
        }

    # --- statements ------------------------------------------------------------------------------------------

    def output(self, node: nodes.Output) -> str:
        return "".join(
            each.data if isinstance(each, nodes.TemplateData) else text_of(self.value(each))
            for each in node.nodes
        )

    def condition(self, node: nodes.If) -> str:
        if _true(self.value(node.test)):
            return self.render(node.body)
        for other in node.elif_:
            if _true(self.value(other.test)):
                return self.render(other.body)
        return self.render(node.else_)

    def assign(self, node: nodes.Assign) -> str:
        if not isinstance(node.target, nodes.Name):
            raise TemplateError("the template sets something that is not a plain name")
        self._variables[node.target.name] = self.value(node.node)
        return ""

    # --- expressions -----------------------------------------------------------------------------------------

    def name(self, node: nodes.Name) -> Any:
        return self._variables.get(node.name, _Undefined(node.name))

    def getattr(self, node: nodes.Getattr) -> Any:
        return _item(self.value(node.node), node.attr)

    def getitem(self, node: nodes.Getitem) -> Any:
        whole = self.value(node.node)
        if isinstance(node.arg, nodes.Slice):
            if not isinstance(whole, str | list):
                raise TemplateError("only texts and lists can be sliced")
            bounds = [None if each is None else int(self.value(each)) for each in _bounds(node.arg)]
            return whole[slice(*bounds)]
        return _item(whole, self.value(node.arg))

    def compare(self, node: nodes.Compare) -> bool:
        left = self.value(node.expr)
        for operand in node.ops:
            right = self.value(operand.expr)
            if not _COMPARISONS[operand.op](left, right):
                return False
            left = right
        return True

    def conditional(self, node: nodes.CondExpr) -> Any:
        if _true(self.value(node.test)):
            return self.value(node.expr1)
        return _Undefined("else") if node.expr2 is None else self.value(node.expr2)

    def apply_filter(self, node: nodes.Filter) -> Any:
        if node.node is None:
            raise TemplateError("filter blocks are not supported")
        value = self.value(node.node)
        positional, named = self.arguments(node)
        if node.name not in _FILTERS_OF_UNDEFINED:
            value = _defined(value)
        return _FILTERS[node.name](value, *positional, **named)

    def test(self, node: nodes.Test) -> bool:
        value = self.value(node.node)
        positional, _ = self.arguments(node)
        return bool(_TESTS[node.name](value, *positional))

    def call(self, node: nodes.Call) -> Any:
        positional, named = self.arguments(node)
        if isinstance(node.node, nodes.Getattr):
            return _METHODS[node.node.attr](_defined(self.value(node.node.node)), *positional, **named)
        called = node.node
        assert isinstance(called, nodes.Name)
        return _FUNCTIONS[called.name](*positional, **named)


def _bounds(node: nodes.Slice) -> list[Any]:
    return [node.start, node.stop, node.step]


def _bounded(value: Any) -> Any:
    if isinstance(value, str) and len(value) > MAX_TEXT:
        raise TemplateError(f"a template made a text of more than {MAX_TEXT} characters")
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > MAX_NUMBER:
        return float(value)
    return value


def _defined(value: Any) -> Any:
    if isinstance(value, _Undefined):
        raise MissingValue(f"the payload has no '{value.name}'")
    return value


def _true(value: Any) -> bool:
    return not isinstance(value, _Undefined) and bool(value)


def _item(whole: Any, key: Any) -> Any:
    if isinstance(whole, dict) and isinstance(key, str | int | float):
        # A literal object in a template may have numbers as keys; those of JSON are texts.
        return whole[key] if key in whole else _Undefined(str(key))
    if isinstance(whole, list | tuple | str) and isinstance(key, int):
        return whole[key] if -len(whole) <= key < len(whole) else _Undefined(str(key))
    return _Undefined(str(key)[:80])


def _number(value: Any, default: Any = None) -> Any:
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        if default is None:
            raise TemplateError(f"{str(value)[:40]!r} is not a number") from None
        return default


def _integer(value: Any, default: Any = None, base: int = 10) -> Any:
    try:
        return int(value[:64], base) if isinstance(value, str) and base != 10 else int(float(value))
    except (TypeError, ValueError, OverflowError):
        if default is None:
            raise TemplateError(f"{str(value)[:40]!r} is not a whole number") from None
        return default


def _round(value: Any, precision: int = 0, method: str = "common", default: Any = None) -> Any:
    number = _number(value, default)
    if not isinstance(number, float) or not math.isfinite(number):
        return number
    scale = 10.0 ** max(-15, min(15, int(precision)))
    if method in ("floor", "ceil"):
        number = (math.floor if method == "floor" else math.ceil)(number * scale) / scale
    else:
        number = round(number, int(precision))
    return int(number) if precision == 0 else number


def _default(value: Any, other: Any = "", boolean: bool = False) -> Any:
    return other if isinstance(value, _Undefined) or (boolean and not value) else value


def _replace(value: Any, old: Any, new: Any) -> str:
    text, old, new = text_of(value), text_of(old), text_of(new)
    if len(text) + text.count(old) * len(new) > MAX_TEXT:
        raise TemplateError(f"a template made a text of more than {MAX_TEXT} characters")
    return text.replace(old, new)


def _join(value: Any, separator: str = "") -> str:
    if isinstance(value, list | tuple) and len(value) * len(separator) > MAX_TEXT:
        raise TemplateError(f"a template made a text of more than {MAX_TEXT} characters")
    return str(separator).join(text_of(each) for each in value)


def _parse_json(value: Any) -> Any:
    try:
        return msgspec.json.decode(text_of(value))
    except msgspec.DecodeError:
        raise TemplateError("from_json was given a text that is no JSON") from None


def _to_json(value: Any, **_: Any) -> str:
    return msgspec.json.encode(value).decode()


def _iif(value: Any, if_true: Any = True, if_false: Any = False, if_none: Any = None) -> Any:
    if value is None and if_none is not None:
        return if_none
    return if_true if _true(value) else if_false


def _add(left: Any, right: Any) -> Any:
    if isinstance(left, int | float) and isinstance(right, int | float):
        return left + right
    if isinstance(left, str) and isinstance(right, str):
        return left + right
    raise TemplateError("only numbers, or texts, can be added")


def _both_numbers(left: Any, right: Any) -> tuple[Any, Any]:
    if isinstance(left, int | float) and isinstance(right, int | float):
        return left, right
    raise TemplateError("only numbers can be computed with; use the filter 'float' or 'int'")


def _binary(operation: Callable[[Any, Any], Any]) -> Callable[[_Evaluation, Any], Any]:
    def evaluate(evaluation: _Evaluation, node: Any) -> Any:
        left = _defined(evaluation.value(node.left))
        return operation(left, _defined(evaluation.value(node.right)))

    return evaluate


def _arithmetic(operation: Callable[[Any, Any], Any]) -> Callable[[_Evaluation, Any], Any]:
    return _binary(lambda left, right: operation(*_both_numbers(left, right)))


def _unary(operation: Callable[[Any], Any]) -> Callable[[_Evaluation, Any], Any]:
    return lambda evaluation, node: operation(evaluation.value(node.node))


def _scalar(value: Any) -> Any:
    """Check that a value is no list and no object: those in each other could grow without limit."""
    if isinstance(value, dict | list | tuple):
        raise TemplateError("lists and objects inside of others, and comparisons of them, are not supported")
    return _defined(value)


def _equal(left: Any, right: Any) -> bool:
    if isinstance(left, _Undefined) or isinstance(right, _Undefined):
        return False
    return bool(_scalar(left) == _scalar(right))


def _within(left: Any, right: Any) -> bool:
    return _scalar(left) in _defined(right)


def _text_method(name: str) -> Callable[..., Any]:
    def call(value: Any, *arguments: Any) -> Any:
        if not isinstance(value, str) or not all(isinstance(each, str | int) for each in arguments):
            raise TemplateError(f"'{name}' works on texts only")
        return getattr(value, name)(*arguments)

    return call


def _get(value: Any, key: Any, default: Any = None) -> Any:
    if not isinstance(value, dict):
        raise TemplateError("'get' works on objects only")
    return value.get(key, default)


def _pairs(evaluation: _Evaluation, node: nodes.Dict) -> dict[Any, Any]:
    return {_scalar(evaluation.value(each.key)): _scalar(evaluation.value(each.value)) for each in node.items}


def _concat(evaluation: _Evaluation, node: nodes.Concat) -> str:
    return "".join(text_of(evaluation.value(each)) for each in node.nodes)


_COMPARISONS: dict[str, Callable[[Any, Any], bool]] = {
    "eq": _equal,
    "ne": lambda left, right: not _equal(left, right),
    "gt": lambda left, right: bool(_scalar(left) > _scalar(right)),
    "gteq": lambda left, right: bool(_scalar(left) >= _scalar(right)),
    "lt": lambda left, right: bool(_scalar(left) < _scalar(right)),
    "lteq": lambda left, right: bool(_scalar(left) <= _scalar(right)),
    "in": _within,
    "notin": lambda left, right: not _within(left, right),
}

_STATEMENTS: dict[str, Callable[[_Evaluation, Any], str]] = {
    "Output": _Evaluation.output,
    "If": _Evaluation.condition,
    "Assign": _Evaluation.assign,
}

_EXPRESSIONS: dict[str, Callable[[_Evaluation, Any], Any]] = {
    "TemplateData": lambda _, node: node.data,
    "Const": lambda _, node: node.value,
    "Name": _Evaluation.name,
    "Getattr": _Evaluation.getattr,
    "Getitem": _Evaluation.getitem,
    "Slice": lambda _, node: None,
    "Compare": _Evaluation.compare,
    "Operand": lambda _, node: None,
    "CondExpr": _Evaluation.conditional,
    "Filter": _Evaluation.apply_filter,
    "Test": _Evaluation.test,
    "Call": _Evaluation.call,
    "Keyword": lambda _, node: None,
    "Pair": lambda _, node: None,
    "List": lambda evaluation, node: [_scalar(evaluation.value(each)) for each in node.items],
    "Tuple": lambda evaluation, node: tuple(_scalar(evaluation.value(each)) for each in node.items),
    "Dict": _pairs,
    "Concat": _concat,
    "And": lambda evaluation, node: _true(evaluation.value(node.left)) and evaluation.value(node.right),
    "Or": lambda evaluation, node: (
        left if _true(left := evaluation.value(node.left)) else evaluation.value(node.right)
    ),
    "Not": _unary(lambda value: not _true(value)),
    "Neg": _unary(lambda value: -_both_numbers(value, 0)[0]),
    "Pos": _unary(lambda value: _both_numbers(value, 0)[0]),
    "Add": _binary(_add),
    "Sub": _arithmetic(lambda left, right: left - right),
    "Mul": _arithmetic(lambda left, right: left * right),
    "Div": _arithmetic(lambda left, right: left / right),
    "FloorDiv": _arithmetic(lambda left, right: left // right),
    "Mod": _arithmetic(lambda left, right: left % right),
}

_FILTERS: dict[str, Callable[..., Any]] = {
    "abs": lambda value: abs(_number(value)),
    "bool": lambda value, default=None: str(value).lower() in ("1", "true", "yes", "on", "enable"),
    "capitalize": lambda value: text_of(value).capitalize(),
    "d": _default,
    "default": _default,
    "first": lambda value: _item(value, 0),
    "float": _number,
    "from_json": _parse_json,
    "iif": _iif,
    "int": _integer,
    "is_defined": _defined,
    "join": _join,
    "last": lambda value: _item(value, -1),
    "length": lambda value: len(value),
    "count": lambda value: len(value),
    "lower": lambda value: text_of(value).lower(),
    "multiply": lambda value, by: _number(value) * _number(by),
    "replace": _replace,
    "round": _round,
    "string": text_of,
    "title": lambda value: text_of(value).title(),
    "to_json": _to_json,
    "tojson": _to_json,
    "trim": lambda value: text_of(value).strip(),
    "upper": lambda value: text_of(value).upper(),
}
_FILTERS_OF_UNDEFINED = frozenset({"d", "default", "iif"})

_TESTS: dict[str, Callable[..., Any]] = {
    "defined": lambda value: not isinstance(value, _Undefined),
    "undefined": lambda value: isinstance(value, _Undefined),
    "none": lambda value: value is None,
    "number": lambda value: isinstance(value, int | float),
    "string": lambda value: isinstance(value, str),
    "mapping": lambda value: isinstance(value, dict),
    "true": lambda value: value is True,
    "false": lambda value: value is False,
    "eq": _equal,
    "equalto": _equal,
}

_METHODS: dict[str, Callable[..., Any]] = {
    "get": _get,
    **{
        name: _text_method(name)
        for name in (
            "lower",
            "upper",
            "strip",
            "split",
            "startswith",
            "endswith",
            "title",
            "lstrip",
            "rstrip",
        )
    },
    "replace": _replace,
}

_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "float": _number,
    "int": _integer,
    "bool": _FILTERS["bool"],
    "iif": _iif,
}
