"""RDF from untrusted clients: valid meanings, and limits."""

from __future__ import annotations

import contextlib
import socket
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from rdflib import Graph

from relay_protocol import jsontext, limits
from relay_protocol.errors import SwitchboardError
from relay_server.http.media_types import JSON_LD, RDF_XML, TURTLE, MediaType
from relay_server.http.rdf.decode import message_in, value_in
from relay_server.http.rdf.serialize import MAXIMUM_NAMESPACES, read
from tests.worlds.growth import grows_linearly, steps

PATH = "/api/v1/robots/rover/topics/cmd_vel"
BASE = f"http://robots.example{PATH}"
WORDS = "http://robots.example/api/v1/vocabulary/"
BODY = limits.HTTP_BODY
"""What a request may carry."""

STEPS_OF_A_BYTE = 8
"""Lines of Python to count the tokens in a byte of a body, at most."""

PREFIXES = f"""
@prefix sosa: <http://www.w3.org/ns/sosa/> .
@prefix rdf: <http://www.w3.org/1999/02/22-rdf-syntax-ns#> .
@prefix xsd: <http://www.w3.org/2001/XMLSchema#> .
@prefix t: <{WORDS}geometry_msgs/Twist#> .
@prefix v: <{WORDS}geometry_msgs/Vector3#> .
@prefix f: <{WORDS}fields#> .
@prefix s: <{WORDS}switchboard#> .
"""
XML = f"""<?xml version="1.0"?>
<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#" xmlns:sosa="http://www.w3.org/ns/sosa/"
  xmlns:t="{WORDS}geometry_msgs/Twist#" xmlns:v="{WORDS}geometry_msgs/Vector3#">
  <rdf:Description rdf:about="">%s</rdf:Description>
</rdf:RDF>"""
GO_XML = XML % (
    '<sosa:hasResult rdf:parseType="Resource"><t:linear rdf:parseType="Resource">'
    '<v:x rdf:datatype="http://www.w3.org/2001/XMLSchema#double">0.2</v:x></t:linear></sosa:hasResult>'
)
GO = {"linear": {"x": 0.2}}
CONTEXT = {
    "sosa": "http://www.w3.org/ns/sosa/",
    "t": f"{WORDS}geometry_msgs/Twist#",
    "hasResult": "sosa:hasResult",
}


def turtle(text: str) -> Graph:
    """A graph in Turtle."""
    return read((PREFIXES + text).encode(), TURTLE, BASE)


def linked(**value: Any) -> Graph:
    """A graph in JSON-LD."""
    return read(jsontext.encode({"@id": BASE, **value}), JSON_LD, BASE)


def refused(body: bytes | str, form: MediaType) -> str:
    """The error of a refused body."""
    with pytest.raises(SwitchboardError) as error:
        message_in(read(body.encode() if isinstance(body, str) else body, form, BASE), PATH)
    return str(error.value)


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> str:
    """No connection or file may be opened; returns the address of an existing file."""

    def never(*arguments: Any, **more: Any) -> Any:
        raise AssertionError(f"something was fetched: {arguments}")

    secret = tmp_path / "secret"
    secret.write_text('{"@context": {}}')
    monkeypatch.setattr(socket.socket, "connect", never)
    monkeypatch.setattr("urllib.request.urlopen", never)
    return secret.as_uri()


def test_all_notations_are_accepted() -> None:
    """With or without datatypes, with nodes inline or by address, on any host of the relay."""
    assert message_in(read(GO_XML.encode(), RDF_XML, BASE), PATH).value == GO
    short = turtle("<> sosa:hasResult [ t:linear [ v:x 0.2 ] ] .")
    assert message_in(short, PATH) == ("geometry_msgs/msg/Twist", GO)
    far = turtle(
        f'<https://proxy{PATH}> sosa:hasResult <#a> . <#a> t:linear <#b> . <#b> v:x "0.2"^^xsd:float .'
    )
    assert message_in(far, PATH).value == GO
    there = linked(
        **{"@context": CONTEXT, "hasResult": {"t:linear": {f"{WORDS}geometry_msgs/Vector3#x": 0.2}}}
    )
    assert message_in(there, PATH).value == GO
    assert value_in(turtle("<> s:value 5 ."), PATH) == 5


@pytest.mark.parametrize(
    ("literal", "value"),
    [
        ('"2023-11-14T22:13:20.000000001Z"^^xsd:dateTime', {"sec": 1_700_000_000, "nanosec": 1}),
        ('"1969-12-31T23:59:59.5+00:00"^^xsd:dateTime', {"sec": -1, "nanosec": 500_000_000}),
        ('"2023-11-14T23:13:20+01:00"^^xsd:dateTime', {"sec": 1_700_000_000, "nanosec": 0}),
        ('"NaN"^^xsd:double', None),
        ('"INF"^^xsd:double', "\0Infinity"),
        ('"-INF"^^xsd:float', "\0-Infinity"),
        ("1e3", 1000.0),
        ('" 1 "^^xsd:boolean', True),
        ('"AQ\\n=="^^xsd:base64Binary', "AQ=="),
        ('"1 NaN"^^s:floatList', [1.0, None]),
        ('"word"@en', "word"),
        ("(1 (2) ())", [1, [2], []]),
    ],
)
def test_values_follow_xml_schema(literal: str, value: Any) -> None:
    """This includes notations that the relay does not write itself."""
    assert value_in(turtle(f"<> s:value {literal} ."), PATH) == value


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("", "0 times"),
        ("<> sosa:hasResult [ ], [ ] .", "2 times"),
        ("<http://robots.example/other> sosa:hasResult [ ] .", "0 times"),
        ("<> sosa:hasResult 5 .", "must be a message"),
        ("<> sosa:hasResult [ t:linear <http://elsewhere/> ] .", "linear must be a value or a node"),
        ("<> sosa:hasResult [ t:linear 1, 2 ] .", "'linear' more than once"),
        ("<> sosa:hasResult [ t:linear 1 ; v:x 2 ] .", "two types at once"),
        ("<> sosa:hasResult [ a <x> ; sosa:linear 1 ] .", "is not a field of a message"),
        ("<> sosa:hasResult [ t:x \"1e999\"^^xsd:double ] .", "out of range"),
        ("<> sosa:hasResult [ t:x \"twelve\"^^xsd:int ] .", "'twelve' is not an integer"),
        ("<> sosa:hasResult [ t:x \"maybe\"^^xsd:boolean ] .", "'maybe' is not a boolean"),
        ("<> sosa:hasResult [ t:x \"1999\"^^xsd:gYear ] .", "gYear> is not supported"),
        ("<> sosa:hasResult [ t:x \"2023-11-14T22:13:20\"^^xsd:dateTime ] .", "with a time zone"),
        ("<> sosa:hasResult [ t:x \"{\"^^rdf:JSON ] .", "not JSON"),
        ("<> sosa:hasResult [ t:x \"?\"^^s:base64Text ] .", "is not UTF-8 in base64"),
        ("<> sosa:hasResult _:a . _:a t:x _:a .", "in several places, or within itself"),
        ("<> sosa:hasResult [ t:x _:l ] . _:l rdf:first 1 ; rdf:rest _:l .", "within itself"),
        ("<> sosa:hasResult [ t:x _:l ] . _:l rdf:first 1 .", "is not a complete list"),
        ("<> sosa:hasResult [", "is not valid text/turtle"),
    ],
)  # fmt: skip
def test_invalid_value_is_refused_with_a_reason(body: str, words: str) -> None:
    """Invalid values are neither guessed nor ignored."""
    assert words in refused(PREFIXES + body, TURTLE)


ENTITIES = """<?xml version="1.0"?><!DOCTYPE r [%s]>""" + XML.partition("?>")[2]


@pytest.mark.parametrize(
    "declared",
    [
        '<!ENTITY a "0.2">',
        "".join(f'<!ENTITY e{n} "{f"&e{n - 1};" * 10}">' for n in range(1, 12)) + '<!ENTITY e0 "lol">',
        '<!ENTITY a SYSTEM "{file}">',
        '<!ENTITY % a SYSTEM "http://robots.example/evil.dtd"> %a;',
    ],
)
def test_entities_are_not_read(alone: str, declared: str) -> None:
    """Neither expansion attacks nor files nor others."""
    body = ENTITIES.replace("%s", declared.replace("{file}", alone), 1)
    assert "DOCTYPE" in refused(body, RDF_XML)


@pytest.mark.parametrize(
    "context",
    [
        "http://robots.example/context.jsonld",
        "{file}",
        ["{file}"],
        {"@import": "{file}"},
        {"a": {"@id": "http://a/", "@context": "{file}"}},
        {"a": {"@id": "http://a/", "@context": {}}},
        {"a": "b:x", "b": "a:y"},
        {"a": "b:", "b": "c:", "c": "http://c/"},
        {"a": 5},
        {"a": "http://a/" + "x" * 2000},
        {f"a{n}": "http://a/" for n in range(1000)},
        5,
    ],
)
def test_contexts_stand_in_the_body(alone: str, context: Any) -> None:
    """No context is fetched, and none can expand."""
    text = jsontext.encode({"@context": context, "@id": BASE}).replace(b"{file}", alone.encode())
    assert "'@context'" in refused(text, JSON_LD)


def test_contexts_stand_at_its_top(alone: str) -> None:
    """Not in nodes, nor in their values."""
    for inner in ({"@context": alone}, [{"x": {"@context": alone}}], {"@import": alone}):
        assert "'@context'" in refused(jsontext.encode({"@id": BASE, "t:x": inner}), JSON_LD)


def test_addresses_are_not_fetched(alone: str) -> None:
    """Addresses in a body are only names."""
    named = (
        f"<> sosa:hasResult [ t:x <{alone}> ] . <{alone}> <http://www.w3.org/2002/07/owl#imports> <{alone}> ."
    )
    refused(PREFIXES + named, TURTLE)
    refused(f"@prefix : <{alone}#> . @base <{alone}> . <> :a :b .", TURTLE)
    refused(XML.replace("<rdf:Description", f'<rdf:Description xml:base="{alone}"') % "<t:x/>", RDF_XML)


def test_values_are_not_xml() -> None:
    """No field has such values, and reading them takes much time."""
    body = XML % f"<sosa:hasResult rdf:parseType='Literal'>{'<b/>' * 10_000}</sosa:hasResult>"
    assert "parseType" in refused(body, RDF_XML)


@pytest.mark.parametrize(
    ("form", "body"),
    [
        (TURTLE, "<a> <b> (" + "1 " * 30_000 + ")."),
        (TURTLE, "<a> <b> (" + '"" ' * 20_000 + ")."),
        (TURTLE, "<a> <b> " + "[]," * 20_000 + "[] ."),
        (RDF_XML, XML % f"<sosa:hasResult rdf:parseType='Collection'>{'<t:a/>' * 9000}</sosa:hasResult>"),
        (JSON_LD, '{"@graph":[' + "{}," * 20_000 + "{}]}"),
        (JSON_LD, '{"http://x/b":{"@list":[' + "1," * 30_000 + "1]}}"),
    ],
)
def test_slow_input_is_refused_before_it_is_read(form: MediaType, body: str) -> None:
    """Its tokens are counted; rdflib executes a hundred lines for each of them."""
    assert "more than 2048" in refused(body, form)
    assert steps(lambda: refused(body, form)) < STEPS_OF_A_BYTE * len(body)


HIDDEN = ("'\"' ", '# "\n', """''' " ''' """, '""""a" """" ', "<a> <b> '''\"''' . ")
"""What Turtle reads as something whole, though a quotation mark in it seems to begin a string, or to go on."""


@pytest.mark.parametrize("edge", HIDDEN)
@pytest.mark.parametrize("words", ["1 ", "+1", ".1", "a:b ", "[]", "'' ", '"""a"""'])
def test_no_quotation_mark_hides_words(edge: str, words: str) -> None:
    """Words between quotation marks are counted too."""
    assert "more than 2048" in refused(f"<a> <b> {edge}({words * 3000}) {edge}.", TURTLE)


FRAGMENTS = {
    TURTLE: r"""" ' \" \' \\" ''' \ < > <a> # a a: _: 1 +1 .1 1. e . ; , ( ) [ ] { } @ @prefix prefix ^^ ^ ! ? = <= %
        \u é "a" 'a' @en & / | ~ $ * """
    + '"""',
    RDF_XML: """< > /> <a <a> </a> <a/> " ' = a=" a="" xmlns:a="" & &amp; &#1; &#x <!-- --> -- <![CDATA[ ]]> ]] <? ?>
        <?a <! a é <a:b <rdf:li/>""",
    JSON_LD: r"""{ } [ ] " \" \ \u "a" "a": : , 1 e . - 0 NaN Infinity true {}, [], "@id" "@id": "@type": "@value":
        "@list": "@context": é "_:a" "http://x/a":1,""",
}
STARTS = {
    TURTLE: ("", "<a> <b> ", "<a> <b> (", '<a> <b> "', '<a> <b> """', "<", 'a="'),
    RDF_XML: ("", "<a>", '<a b="', "<a ", "<!DOCTYPE ", XML.partition("%s")[0]),
    JSON_LD: ("", "{", '{"a":', '{"http://x/":"', '{"@graph":[', '{"@context":{"', "["),
}


@st.composite
def shapes(draw: st.DrawFn) -> tuple[MediaType, str, str, str]:
    """A format, the start of a body, its repeated part, and its end."""
    form = draw(st.sampled_from([TURTLE, RDF_XML, JSON_LD]))
    fragment = st.sampled_from([*FRAGMENTS[form].split(), " ", "\n", "\r", "\t", "\x0c", "\u00a0"])
    unit = "".join(draw(st.lists(fragment, min_size=1, max_size=4)))
    return form, draw(st.sampled_from(STARTS[form])), unit, "".join(draw(st.lists(fragment, max_size=2)))


@settings(max_examples=200, deadline=None)
@given(shapes())
@example((TURTLE, '"', '\\"', ""))
@example((TURTLE, 'a="', '\\"', ""))
@example((TURTLE, "<a> <b> '", "\\'", ""))
@example((TURTLE, '"""', '\\"""', ""))
@example((TURTLE, "", "<a ", ""))
@example((TURTLE, "", '""" ""', ""))
@example((TURTLE, "", "#", ""))
def test_twice_as_much_takes_no_more_than_twice_as_long(shape: tuple[MediaType, str, str, str]) -> None:
    """For any structure of the body."""
    form, start, unit, end = shape

    def try_to_read(body: bytes) -> None:
        with contextlib.suppress(SwitchboardError):
            read(body, form, BASE)

    assert grows_linearly(
        try_to_read, lambda times: (start + unit * times + end).encode(), BODY // len(unit.encode())
    )


def test_namespaces_are_few() -> None:
    """This includes nested declarations."""
    names = [f' xmlns:n{each}="u:"' for each in range(1000)]
    for body in (f"<a{''.join(names)}/>", f"<a>{''.join(f'<a{each}/>' for each in names)}</a>"):
        assert "namespaces" in refused(body, RDF_XML)


@pytest.mark.parametrize("declares", ["@prefix n{0}:<u:{0}>.", "PREFIX n{0}: <u:{0}>", "prefix n{0}:<u:{0}>"])
def test_prefixes_are_few(declares: str) -> None:
    """In any notation; fields of the same name are not counted."""
    assert "namespaces" in refused(
        "".join(declares.format(each) for each in range(MAXIMUM_NAMESPACES + 1)), TURTLE
    )
    few = "".join(declares.format(each) for each in range(MAXIMUM_NAMESPACES))
    fields = "<> <u:f> <u:prefix/prefix#prefix>, n0:prefix. " * 300
    assert len(read((few + fields).encode(), TURTLE, BASE)) == 2


def nested(form: MediaType, depth: int) -> str:
    """A message in a message, nested this deep."""
    if form is TURTLE:
        return PREFIXES + "<> sosa:hasResult " + "[ f:x " * depth + "1" + " ]" * depth + " ."
    if form is JSON_LD:
        within = f'{{"{WORDS}fields#x":' * depth + "1" + "}" * depth
        return f'{{"@id": "{BASE}", "http://www.w3.org/ns/sosa/hasResult": {within}}}'
    open_, close = '<t:x rdf:parseType="Resource">', "</t:x>"
    return XML % f"<sosa:hasResult rdf:parseType='Resource'>{open_ * depth + close * depth}</sosa:hasResult>"


@pytest.mark.parametrize("form", [TURTLE, JSON_LD, RDF_XML])
@pytest.mark.parametrize("depth", [100, 400])
def test_deep_nesting_is_refused(form: MediaType, depth: int) -> None:
    """At any depth, with a reason."""
    assert "deep" in refused(nested(form, depth), form)


def test_a_shared_node_does_not_stand_for_many() -> None:
    """Otherwise thirty lines could expand to a billion fields."""
    lines = "".join(f"_:n{each} f:a _:n{each + 1} ; f:b _:n{each + 1} ." for each in range(30))
    assert "several places" in refused(f"{PREFIXES}<> sosa:hasResult _:n0 . {lines} _:n30 f:a 1 .", TURTLE)


@pytest.mark.parametrize(
    ("form", "body"),
    [
        (TURTLE, f"{PREFIXES}<> s:value {'9' * 47_000} ."),
        (TURTLE, f'{PREFIXES}<> s:value "1e999999999"^^xsd:decimal .'),
        (TURTLE, f'{PREFIXES}<> s:value "{"9" * 47_000}"^^xsd:gYear .'),
        (
            TURTLE,
            f"{PREFIXES}<> s:value \"<!DOCTYPE a [<!ENTITY b SYSTEM 'file:///'>]>&b;\"^^rdf:XMLLiteral .",
        ),
        (TURTLE, f"@prefix a: <http://{'a' * 25_000}> . {'a:a a:a a:a . ' * 1500}"),
        (TURTLE, "\n" * BODY),
        (TURTLE, "[" * BODY),
        (TURTLE, '"' * BODY),
        (RDF_XML, "<a" + "".join(f' xmlns:n{each}="u:"' for each in range(3000)) + "/>"),
        (RDF_XML, f'<a xmlns="http://{"a" * 30_000}">{"<a/>" * 5000}</a>'),
        (RDF_XML, '<?xml version="1.0" encoding="utf-16"?><a/>'),
        (RDF_XML, "<a>" * 15_000),
        (JSON_LD, '{"a":' * 10_000),
        (JSON_LD, "[]"),
        (
            JSON_LD,
            '{"@id": {"@id": []}, "@type": [[5]], "@reverse": 5, "@graph": {"@graph": [1, {"@value": {}}]}}',
        ),
    ],
)
def test_huge_or_odd_number_is_refused_with_a_reason(form: MediaType, body: str) -> None:
    """A small body must not become large by being read."""
    assert len(body) <= BODY + 1024
    assert 0 < len(refused(body, form)) < 500


def test_a_body_is_utf8() -> None:
    """Other declared encodings do not matter."""
    for form in (TURTLE, JSON_LD, RDF_XML):
        assert "not UTF-8" in refused(GO_XML.encode("utf-16"), form)
