"""The parts of a Role that start with it: modules, programs, devices, pipes, and pipes for mappings.

A mapping joins topics and ports of programs, or fields of them with arguments and fields of the replies of services,
and with fields of goals and of their results. An element without a resource in its Role has those of other Roles;
then the pipe runs while these are started, too.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import NamedTuple

import msgspec

from relay_protocol.errors import Invalid
from relay_server.pipes.schemas import FieldMapping, NewPipe, PipeEnd
from relay_server.roles.bindings import Binding, binding_of, field_path
from relay_server.roles.schemas import RoleElement

SOFTWARE = frozenset({"process", "software", "softwareElement"})
"""Elements of these types are switched on with their Role, if they are bound to a device. Data never is."""

MAX_PARTS = 200


class RolePart(msgspec.Struct):
    """A part of a Role that was started.

    :param element: its name; of a mapping, both names
    :param resource: as the document has it, or the pipe of a mapping
    :param mapped: whether the pipe was made for a mapping, so that it is removed with the Role's end
    :param new: of a mapping, the pipe as JSON
    :param needs: of a mapping, for each end in other Roles the Roles that have it; one of them must be started
    :param waits: whether it is not started, as one of these is not
    :param error: why it was not started, or not stopped
    :param still_runs: whether it could not be stopped, but a second stop may succeed
    """

    element: str
    resource: str
    mapped: bool = False
    new: str = ""
    needs: list[list[str]] = []
    waits: bool = False
    error: str = ""
    still_runs: bool = False

    @property
    def binding(self) -> Binding:
        """The resource."""
        found = binding_of(self.resource)
        assert found is not None
        return found

    def waits_for(self, started: Collection[str]) -> str:
        """The Roles that must be started before it, in words; empty: none."""
        missing = [each for each in self.needs if not any(role in started for role in each)]
        return " and ".join(" or ".join(each) for each in missing)

    @property
    def robots(self) -> list[str]:
        """Names of the robots that it concerns, as far as the Role has them."""
        if self.new:
            pipe = msgspec.json.decode(self.new, type=NewPipe)
            return [each.robot for each in (pipe.source, pipe.target) if each.robot]
        return [self.binding.robot] if self.binding.robot else []


class _End(NamedTuple):
    """One end of a mapping.

    :param role: another Role that has it; empty for the Role itself
    """

    binding: Binding
    role: str = ""


class _Mapped(NamedTuple):
    """A pair of ends that a mapping joins.

    :param element: names of both elements
    """

    element: str
    source: _End
    target: _End


def unbound(elements: Iterable[RoleElement]) -> list[str]:
    """Names of elements that mappings join, but that have no resource in their Role."""
    elements = list(elements)
    bound = {each.name for each in elements if each.resources}
    joined = {name for each in elements if each.mappings for name in (each.name, *each.mappings)}
    return sorted(joined - bound)


def plan_of(
    role_id: int, elements: Iterable[RoleElement], others: Mapping[str, Mapping[str, list[str]]] | None = None
) -> list[RolePart]:
    """The parts of a Role, in the order of starting.

    :param others: resources of elements in other Roles, by the element's and the Role's name
    :raises Invalid: there are too many
    """
    elements = list(elements)
    parts = [
        *_of_kind(elements, "modules"),
        *_of_kind(elements, "programs"),
        *_devices(elements),
        *_of_kind(elements, "pipes"),
    ]
    seen: dict[str, RolePart] = {}
    for each in parts:
        seen.setdefault(each.resource, each)
    parts = [*seen.values(), *_mappings(role_id, elements, others or {})]
    if len(parts) > MAX_PARTS:
        raise Invalid(f"the Role has {len(parts)} parts to start; {MAX_PARTS} are allowed")
    return parts


def _of_kind(elements: Iterable[RoleElement], kind: str) -> Iterator[RolePart]:
    for each in elements:
        for binding in _bindings(each):
            if binding.kind == kind:
                yield RolePart(each.name, binding.text)


def _devices(elements: Iterable[RoleElement]) -> Iterator[RolePart]:
    for each in elements:
        for binding in _bindings(each):
            if SOFTWARE.intersection(each.types) and binding.kind in ("services", "topics"):
                yield RolePart(each.name, binding.text)


def _mappings(
    role_id: int, elements: list[RoleElement], others: Mapping[str, Mapping[str, list[str]]]
) -> Iterator[RolePart]:
    """A pipe for each pair of topics, ports or services with mappings from one to the other."""
    own = {each.name: each.resources for each in elements if each.resources}

    def ends(name: str) -> list[_End]:
        if name in own:
            return [_End(each) for each in _carried(own[name])]
        return [_End(each, role) for role, found in others.get(name, {}).items() for each in _carried(found)]

    pairs: dict[tuple[tuple[str, str, str], ...], list[_Mapped]] = {}
    for each in elements:
        for name in each.mappings:
            for source in ends(each.name):
                for target in ends(name):
                    bindings = source.binding, target.binding
                    key = tuple((end.robot, end.kind, end.name) for end in bindings)
                    if key[0] != key[1]:
                        mapped = _Mapped(f"{each.name} → {name}", source, target)
                        pairs.setdefault(key, []).append(mapped)
    for number, pair in enumerate(pairs.values(), 1):
        yield _pipe_part(f"role-{role_id}-{number}", pair)


def _pipe_part(name: str, mapped: list[_Mapped]) -> RolePart:
    # Several Roles may have the same resource; then it is carried once.
    roles: dict[tuple[str, Binding, Binding], tuple[set[str], set[str]]] = {}
    for each in mapped:
        found = roles.setdefault((each.element, each.source.binding, each.target.binding), (set(), set()))
        found[0].add(each.source.role)
        found[1].add(each.target.role)
    needs = {tuple(sorted(end)) for ends in roles.values() for end in ends if "" not in end}
    element = ", ".join(dict.fromkeys(each for each, _, _ in roles))
    part = RolePart(element, f"pipes/{name}", mapped=True, needs=[list(each) for each in sorted(needs)])
    bindings = [(source, target) for _, source, target in roles]
    source, target = bindings[0]
    whole = [not (a.pointer or b.pointer) for a, b in bindings]
    paths = [[_path(end) for end in pair] for pair in bindings]
    if not all(whole) and not all(map(all, paths)):
        part.error = "a field can't be mapped to a whole message; map a field to a field"
        return part
    fields = [] if all(whole) else [FieldMapping(a, b) for a, b in paths]
    new = NewPipe(
        name=name,
        source=_pipe_end(source),
        target=_pipe_end(target),
        fields=fields,
    )
    part.new = msgspec.json.encode(new).decode()
    try:
        msgspec.json.decode(part.new, type=NewPipe)
    except msgspec.ValidationError as error:
        part.new, part.error = "", f"this can't be mapped: {error}"
    return part


def _path(binding: Binding) -> str:
    """The field of a binding; of a port as a whole its only one."""
    return field_path(binding) or ("data" if binding.kind == "ports" else "")


def _pipe_end(binding: Binding) -> PipeEnd:
    if binding.kind == "ports":
        program, _, port = binding.name.partition("/")
        return PipeEnd(program=program, port=port)
    name = binding.name if binding.name.startswith("/") else f"/{binding.name}"
    return PipeEnd(binding.robot, **{binding.kind.removesuffix("s"): name})


def _carried(resources: Iterable[str]) -> list[Binding]:
    """A mapping can carry topics, ports and fields of services and actions. Only commands call these as a whole."""
    return [
        each
        for each in map(binding_of, resources)
        if each is not None
        and (each.kind in ("topics", "ports") or (each.kind in ("services", "actions") and each.pointer))
    ]


def _bindings(element: RoleElement) -> Iterator[Binding]:
    for each in element.resources:
        binding = binding_of(each)
        if binding is not None:
            yield binding
