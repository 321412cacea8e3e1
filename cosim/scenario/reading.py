"""A scenario file, and what the command line changes of it, read and validated: every problem at once, located."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

from cosim.errors import ConfigError, Location, Problem, suggest
from cosim.scenario import profiles
from cosim.scenario.mending import Doubts, Step, cut, in_one_piece
from cosim.scenario.merging import Override, merge
from cosim.scenario.names import agent_names
from cosim.scenario.source import Node, read
from cosim.scenario.spec import AgentSpec, ScenarioSpec
from cosim.scenario.terms import term
from network.channel import ChannelModel

Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True)
class AgentEntry:
    """One agent: its template and every entry that names it, merged.

    Attributes:
        spec: validated.
        node: where each part of it was written.
        template: name of its template, if it has one.
    """

    spec: AgentSpec
    node: Node
    template: str | None


@dataclass(frozen=True)
class Scenario:
    """A validated scenario.

    Attributes:
        path: the file.
        spec: the whole.
        root: where each part of it was written.
        agents: by name, in the order of the file; agents that are written alike share one entry.
        label: what locations call the file.
        problems: what is wrong with how it is written; the rest of the scenario is there, to be checked as well.
        doubts: what is not there because of them.
    """

    path: Path
    label: str
    spec: ScenarioSpec
    root: Node
    agents: Mapping[str, AgentEntry]
    problems: tuple[Problem, ...]
    doubts: Doubts

    @property
    def name(self) -> str:
        """The name given, else the file's."""
        return self.spec.name or self.path.stem

    def folder(self, where: Location) -> Path:
        """What a relative path that was written at `where` is relative to: the file's folder, or on the command line
        the current one.
        """
        return self.path.parent if where.file == self.label else Path()


def read_scenario(path: Path, label: str | None = None, overrides: Sequence[Override] = ()) -> Scenario:
    """The scenario in a file, as far as it has the right form.

    Args:
        path: the YAML file.
        label: what locations call it; `path` as given, by default.
        overrides: applied in their order; those of agents win over every entry of the file.

    Raises:
        ConfigError: it is no YAML, or so little of it has the right form that nothing else can be checked.
    """
    label = label or str(path)
    problems: list[Problem] = []
    root = read(path, label, problems)
    root = profiles.resolve(root, path.parent, label)  # so that an override can change a value of a profile
    late: list[tuple[str, Node]] = []
    for override in overrides:
        try:
            root = override.apply(root)
        except ConfigError as error:
            problems += error.problems
        if override.path[0] == "agents" and len(override.path) > 1:
            late.append((override.path[1], _nested(override)))
    root = profiles.resolve(root, path.parent, label, problems)
    refused = {problem.where for problem in problems}
    doubts = Doubts()
    spec, root, found = _validate_in_part(ScenarioSpec, root, doubts, {"folder": path.parent})
    problems += [problem for problem in found if problem.where not in refused]
    if spec is None:
        raise ConfigError(_unique(problems))
    agents, found = _merge_agents(root, late, doubts)
    return Scenario(path, label, spec, root, agents, tuple(_unique([*problems, *found])), doubts)


def _nested(override: Override) -> Node:
    """The entry of an agent that says only what the override says."""
    node = override.value
    for step in reversed(override.path[2:]):
        node = Node({step: node}, override.where, override.where)
    return node


def _merge_agents(
    root: Node, late: Sequence[tuple[str, Node]], doubts: Doubts
) -> tuple[dict[str, AgentEntry], list[Problem]]:
    """Every agent with what is written for it. Agents with the same entries are merged and validated once."""
    if not doubts.all_agents_known:
        return {}, []  # an entry is missing that may make others whole
    entries: dict[str, list[Node]] = {}
    agents = root.child("agents")
    for key, entry in [*(agents.mapping.items() if agents else ()), *late]:
        for name in agent_names(key):
            entries.setdefault(name, []).append(entry)
    known: dict[tuple[int, ...], AgentEntry | None] = {}
    problems: list[Problem] = []
    merged: dict[str, AgentEntry] = {}
    for name, own in entries.items():
        key_of_alike = tuple(id(entry) for entry in own)
        if key_of_alike not in known:
            known[key_of_alike], found = _merge_agent(root, own, doubts)
            problems += found
        if (entry_of_agent := known[key_of_alike]) is not None:
            merged[name] = entry_of_agent
        else:
            doubts.add_agent(name)
    return merged, problems


def _merge_agent(root: Node, entries: Sequence[Node], doubts: Doubts) -> tuple[AgentEntry | None, list[Problem]]:
    node = entries[0]
    for entry in entries[1:]:
        node = merge(node, entry)
    name = node.child("template")
    if name is not None:
        template = root.find("templates", str(name.value))
        if template is None:
            templates = root.child("templates")
            known = templates.mapping if templates else {}
            return None, [Problem(f"unknown template {str(name.value)!r}{suggest(str(name.value), known)}", name.where)]
        node = merge(template, node)
        if "template" in template.mapping:
            at = template.locate("template", key=True)
            return None, [Problem("a template cannot start from another template", at)]
    if (coupling := root.child("coupling")) is not None:
        node = merge(Node({"coupling": coupling}, node.where, node.key), node)
    spec, node, problems = _validate_in_part(AgentSpec, node, doubts)
    return (AgentEntry(spec, node, str(name.value) if name is not None else None) if spec else None), problems


def _unique(problems: Iterable[Problem]) -> list[Problem]:
    """Each problem once, in the order of the file."""
    return sorted(dict.fromkeys(problems), key=lambda problem: problem.where or Location(""))


# --- pydantic's errors as sentences -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Mistake:
    """Something of the wrong form.

    Attributes:
        problem: what the user reads.
        path: where it is.
        known: keys that there may be in its place.
    """

    problem: Problem
    path: tuple[Step, ...]
    known: tuple[str, ...] = ()


_MOST_CUTS = 20


def _validate_in_part(
    model: type[Model], node: Node, doubts: Doubts, context: Mapping[str, Any] | None = None
) -> tuple[Model | None, Node, list[Problem]]:
    """The model of what has the right form in a tree, that part of the tree, and everything wrong with the rest."""
    problems: list[Problem] = []
    for attempt in range(_MOST_CUTS):
        spec, mistakes = _validate(model, node, context)
        if not attempt:
            problems = _unique(mistake.problem for mistake in mistakes)
        if spec is not None:
            return spec, node, problems
        for mistake in sorted(mistakes, key=lambda mistake: _last_first(mistake.path)):
            if (smaller := cut(node, in_one_piece(mistake.path))) is None:
                return None, node, problems
            node, path = smaller
            doubts.add(path, mistake.known)
    return None, node, problems


def problems_of(
    form: TypeAdapter[ChannelModel], node: Node, context: Mapping[str, Any]
) -> tuple[ChannelModel | None, list[Problem]]:
    """The channel that stands alone in a tree, or everything that is wrong with it."""
    try:
        return form.validate_python(node.plain(), context=dict(context)), []
    except ValidationError as error:
        schema = form.json_schema(by_alias=True)
        details = error.errors(include_url=False)
        mistakes = [_mistake(detail, node, schema) for detail in details]
        return None, _unique(replace(one.problem, see=term(node, one.path)) for one in mistakes)


def _last_first(path: Sequence[Step]) -> list[tuple[int, str]]:
    """Sorts elements of a list from the last to the first, so that cutting one does not move the next."""
    return [(-step, "") if isinstance(step, int) else (0, step) for step in path]


def _validate(model: type[Model], node: Node, context: Mapping[str, Any] | None) -> tuple[Model | None, list[_Mistake]]:
    """The model of a tree, or everything that is wrong with it."""
    try:
        return model.model_validate(node.plain(), context=dict(context or {})), []
    except ValidationError as error:
        details = error.errors(include_url=False)
        schema = model.model_json_schema(by_alias=True)
        return None, [_mistake(detail, node, schema) for detail in details]


def _mistake(detail: Mapping[str, Any], node: Node, schema: Mapping[str, Any]) -> _Mistake:
    kind, steps = detail["type"], tuple(detail["loc"])
    known: list[str] = []
    if steps and steps[-1] == "[key]":
        path, _ = _trace(schema, steps[:-1])
        message, where = _sentence(detail, path), node.locate(*path, key=True)
    elif kind == "missing":
        above, _ = _trace(schema, steps[:-1])
        path = [*above, steps[-1]]
        message, where = f"{_prefix(above)}{steps[-1]!r} is missing", node.locate(*above)
    elif kind == "extra_forbidden":
        above, known = _trace(schema, steps[:-1])
        wrong = str(steps[-1])
        path = [*above, wrong]
        message = f"{_prefix(above)}unknown key {wrong!r}{suggest(wrong, known)}"
        where = node.locate(*path, key=True)
    else:
        path, _ = _trace(schema, steps)
        message, where = _sentence(detail, path), node.locate(*path)
    return _Mistake(Problem(message, where, see=_see(node, path)), tuple(path), tuple(known))


def _see(node: Node, path: Sequence[Step]) -> str | None:
    """The place in the docs that explains what is wrong, if it is in a channel."""
    if len(path) > 1 and path[0] == "channels":
        return term(node.find("channels", path[1]), path[2:])
    return None


def _prefix(path: Sequence[Step]) -> str:
    return f"{'.'.join(map(str, path))}: " if path else ""


def _sentence(detail: Mapping[str, Any], path: Sequence[Step]) -> str:
    kind, context, value = detail["type"], detail.get("ctx", {}), detail["input"]
    if kind == "value_error":
        said = str(context["error"])
    elif kind in ("literal_error", "enum"):
        options = _options(context["expected"])
        hint = suggest(value, options) if isinstance(value, str) else ""
        said = f"{_shown(value)} is none of {', '.join(options)}{hint}"
    elif kind in _MUST_BE:
        said = f"must be {_MUST_BE[kind]}, not {_shown(value)}"
    elif kind in _BOUNDS:
        (bound,) = context.values()
        said = f"must be {_BOUNDS[kind]} {bound if isinstance(bound, int) else f'{bound:g}'}, not {_shown(value)}"
    elif kind == "too_short" and context["min_length"] == 1:
        said = "must not be empty"
    elif kind in ("too_short", "too_long"):
        wanted = context["min_length" if kind == "too_short" else "max_length"]
        said = f"must have {wanted} elements, not {context['actual_length']}"
    else:
        said = detail["msg"][:1].lower() + detail["msg"][1:]
    return f"{_prefix(path)}{said}"


_MUST_BE = {
    "string_type": "text (in quotes if it looks like a number)",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "int_parsing": "a whole number",
    "float_type": "a number",
    "float_parsing": "a number",
    "finite_number": "a finite number",
    "bool_type": "true or false",
    "list_type": "a list, such as [a, b]",
    "tuple_type": "a list, such as [a, b]",
    "dict_type": "a mapping of keys to values",
    "model_type": "a mapping of keys to values",
    "model_attributes_type": "a mapping of keys to values",
}
_BOUNDS = {
    "greater_than": "more than",
    "greater_than_equal": "at least",
    "less_than": "less than",
    "less_than_equal": "at most",
}


def _options(expected: str) -> list[str]:
    """The options in pydantic's `'a', 'b' or 'c'`."""
    return expected.replace("'", "").replace(" or ", ", ").split(", ")


def _shown(value: Any) -> str:
    if value is None:
        return "empty"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, (list, tuple)):
        return "a list"
    return repr(value)


# --- pydantic's paths, read with the JSON schema ----------------------------------------------------------------------


def _trace(schema: Mapping[str, Any], steps: Sequence[Step]) -> tuple[list[Step], list[str]]:
    """Where an error's path leads in the file, and which keys a mapping there may have.

    Among the keys of the file, pydantic's paths name the variants of unions: by the value of the key that tells them
    apart, or as `<…>` where `cosim.scenario.spec` names them.
    """
    definitions = schema.get("$defs", {})
    here = [schema]
    path: list[Step] = []
    for step in steps:
        tagged = [part["discriminator"]["mapping"].get(step) for part in here if "discriminator" in part]
        if any(tagged):
            here = [_resolved({"$ref": reference}, definitions) for reference in tagged if reference]
        elif not str(step).startswith("<"):
            path.append(step)
            below = [
                inner for part in here for variant in _variants(part, definitions) for inner in _below(variant, step)
            ]
            here = [_resolved(part, definitions) for part in below]
    variants = [variant for part in here for variant in _variants(part, definitions)]
    return path, list(dict.fromkeys(key for variant in variants for key in variant.get("properties", {})))


def _resolved(schema: Mapping[str, Any], definitions: Mapping[str, Any]) -> Mapping[str, Any]:
    """What a reference refers to."""
    while "$ref" in schema:
        schema = definitions[schema["$ref"].rsplit("/", 1)[1]]
    return schema


def _variants(schema: Mapping[str, Any], definitions: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """A schema with its unions taken apart."""
    schema = _resolved(schema, definitions)
    inner = [*schema.get("anyOf", ()), *schema.get("oneOf", ())]
    if not inner:
        yield schema
    for variant in inner:
        yield from _variants(variant, definitions)


def _below(schema: Mapping[str, Any], step: Step) -> Iterator[Mapping[str, Any]]:
    if isinstance(step, int):
        if "items" in schema:
            yield schema["items"]
    elif step in schema.get("properties", {}):
        yield schema["properties"][step]
    elif isinstance(schema.get("additionalProperties"), dict):
        yield schema["additionalProperties"]
