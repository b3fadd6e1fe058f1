"""Templates of devices: the forms people use, and that no other code runs."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.platforms.mqtt.templates import (
    MAX_TEXT,
    MissingValue,
    Template,
    TemplateError,
    value_variables,
)


@pytest.mark.parametrize(
    ("template", "payload", "text"),
    [
        ("{{ value }}", "x", "x"),
        ("{{ value_json.temperature }}", '{"temperature": 21.5}', "21.5"),
        ("{{ value_json['a b'] }}", '{"a b": 1}', "1"),
        ("{{ value_json[0].a }}", '[{"a": 3}]', "3"),
        ("{{ value_json.a.b[1] }}", '{"a": {"b": [1, 2]}}', "2"),
        ("{{ value | float / 10 }}", "215", "21.5"),
        ("{{ (value_json.x | float * 1.8 + 32) | round(1) }}", '{"x": "21"}', "69.8"),
        ("{{ value | int }}", "7.9", "7"),
        ("{{ value | round(0) }}", "7.6", "8"),
        ("{{ 'ON' if value_json.contact else 'OFF' }}", '{"contact": true}', "ON"),
        ("{% if value == '1' %}ON{% elif value == '2' %}HALF{% else %}OFF{% endif %}", "2", "HALF"),
        ("{{ {'0': 'off', '1': 'heat'}[value] }}", "1", "heat"),
        ("{% set m = {'0': 'off', '1': 'heat'} %}{{ m[value] if value in m else 'off' }}", "9", "off"),
        ("{{ value_json.x | default('none') }}", "{}", "none"),
        ("{{ value_json.get('x', 4) + 1 }}", "{}", "5"),
        ("{{ value.split(',')[1] | trim }}", "a, b", "b"),
        ("{{ value_json.x is defined }}", "{}", "False"),
        ("{{ value[0:2] }}", "hello", "he"),
        ("{{ value | upper ~ '!' }}", "a", "A!"),
        ("{{ iif(value == 'a', 'yes', 'no') }}", "a", "yes"),
        ("{{ value_json | tojson }}", '{"a":[1]}', '{"a":[1]}'),
        ("{{ value_json.brightness | int // 2 }}", '{"brightness": 9}', "4"),
        ("{{ value_json.a and not value_json.b }}", '{"a": true, "b": false}', "True"),
    ],
)
def test_forms_that_devices_use(template: str, payload: str, text: str) -> None:
    assert Template(template).render(value_variables(payload)) == text


@pytest.mark.parametrize(
    ("template", "payload"),
    [("{{ value_json.x }}", "{}"), ("{{ value_json.x }}", "no json"), ("{{ value_json.x | float }}", "{}")],
)
def test_missing_value_is_no_new_state(template: str, payload: str) -> None:
    with pytest.raises(MissingValue):
        Template(template).render(value_variables(payload))


@pytest.mark.parametrize(
    "template",
    [
        "{% for x in range(10) %}{{ x }}{% endfor %}",
        "{% macro f() %}{% endmacro %}",
        "{% include 'x' %}",
        "{{ 10 ** 10 }}",
        "{{ states('sensor.x') }}",
        "{{ value.format(1) }}",
        "{{ cycler.__init__.__globals__.os.popen('id') }}",
        "{{ value | attr('x') }}",
        "{{ value | map('upper') | list }}",
        "{{ lipsum() }}",
        "{{ value",
        "{{ " + "(" * 3000 + ") }}",
        "x" * 5000,
    ],
)
def test_everything_else_is_refused_when_it_is_read(template: str) -> None:
    with pytest.raises(TemplateError):
        Template(template)


@pytest.mark.parametrize(
    "template",
    [
        "{{ value.__class__.__mro__ }}",
        "{{ value.replace('x', value).replace('x', value).replace('x', value) }}",
        "{% set a = [value, value] %}{% set b = [a, a] %}{{ b }}",
        "{{ " + " ~ ".join(["value"] * 400) + " }}",
        "{{ value * 1000000 }}",
        "{{ 1 / 0 }}",
        "{{ -value }}",
        "{{ value | float }}",
    ],
)
def test_attacks_end_in_an_error(template: str) -> None:
    with pytest.raises(TemplateError):
        Template(template).render(value_variables("x" * 1000))


WORDS = (
    "value value_json {{ }} {% %} if set a = | float tojson ( ) [ ] { } : ' ~ + * - . , 0 1 "
    "999999999999999999999999999 replace get split join"
)
PIECES = st.sampled_from(WORDS.split())


@given(st.lists(PIECES, max_size=40).map(" ".join), st.text(max_size=50))
def test_any_template_gives_a_text_or_an_error(template: str, payload: str) -> None:
    with contextlib.suppress(TemplateError):
        assert len(Template(template).render(value_variables(payload))) <= MAX_TEXT


@given(st.text(max_size=100))
def test_any_text_as_a_template(template: str) -> None:
    with contextlib.suppress(TemplateError):
        Template("{{" + template + "}}").render(value_variables('{"a": [1, {"b": null}]}'))
