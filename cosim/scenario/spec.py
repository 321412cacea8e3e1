"""A scenario exactly as the user writes it: which keys there are, what they hold, and what each means.

These models check what can be checked without opening a component; `cosim.planning` does the rest. The JSON schema
that `cosim schema` prints for editors is made from them.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    Discriminator,
    Field,
    FiniteFloat,
    GetJsonSchemaHandler,
    Tag,
    WithJsonSchema,
    model_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema
from typing_extensions import TypeAliasType

from cosim.errors import suggest
from cosim.scenario.form import FORM
from cosim.scenario.mapped import MappedInput, MappedOutput
from cosim.scenario.names import agent_names, scenario_name
from network.envelope import check_name
from network.models import AnyChannelModel
from network.units import PositiveDuration

PARAMETER_PORTS = ("count", "period")
"""Keys of `receive` that name a parameter: set to the number of in-neighbours, and to the period in seconds."""
MAILBOX_PORTS = (*PARAMETER_PORTS, "stamp", "time", "weight")
"""Keys of `receive` that are no variables of the message."""
RESERVED_PROCESSES = ("orchestrator", "emulator")


class Spec(BaseModel):
    """Base of every part of a scenario: no unknown keys, no silent conversions."""

    model_config = FORM


# --- names ------------------------------------------------------------------------------------------------------------


def _check_agents(text: str) -> str:
    list(agent_names(text))
    return text


def _as_text(value: Any) -> Any:
    """A name may look like a number: `from: 1`."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _check_agents_or_all(text: str) -> str:
    return text if text.strip() == ALL else _check_agents(text)


ALL = "*"
_NAME_SCHEMA = {"type": ["string", "integer"]}

Name: TypeAlias = Annotated[str, BeforeValidator(_as_text), WithJsonSchema(_NAME_SCHEMA)]
Agents: TypeAlias = Annotated[
    str, BeforeValidator(_as_text), AfterValidator(_check_agents), WithJsonSchema(_NAME_SCHEMA)
]
AgentsOrAll: TypeAlias = Annotated[
    str, BeforeValidator(_as_text), AfterValidator(_check_agents_or_all), WithJsonSchema(_NAME_SCHEMA)
]


def _check_reference(text: str) -> str:
    component, dot, variable = text.partition(".")
    if not (component.strip() and dot and variable.strip()):
        raise ValueError(f"{text!r} is no variable of a component; write 'component.variable', such as 'plant.p'")
    return text.strip()


Reference: TypeAlias = Annotated[
    str,
    AfterValidator(_check_reference),
    WithJsonSchema({"type": "string", "pattern": r"^\s*[^.\s][^.]*\..*\S\s*$", "examples": ["plant.p"]}),
]
"""`component.variable`; the variable's own name may hold dots."""


def check_component(text: str) -> str:
    """A name that a component can have.

    Raises:
        ValueError: it is none.
    """
    if not re.fullmatch(r"[^\W\d]\w*", text):
        raise ValueError(f"{text!r} cannot name a component; use letters, digits and '_', such as 'plant'")
    return text


ComponentName: TypeAlias = Annotated[str, AfterValidator(check_component)]


# --- components -------------------------------------------------------------------------------------------------------


def _check_scalar(value: Any) -> Any:
    if not isinstance(value, (bool, int, float, str)):
        raise ValueError("must be a number, true or false, or text")  # noqa: TRY004 - pydantic's
    if isinstance(value, float) and math.isnan(value):
        raise ValueError("'.nan' is no value to start from")
    return value


Scalar: TypeAlias = Annotated[
    Any, BeforeValidator(_check_scalar), WithJsonSchema({"type": ["number", "boolean", "string"]})
]


class Uniform(Spec):
    """Drawn from the seed, evenly between two bounds, one draw per element."""

    uniform: Annotated[list[FiniteFloat], Field(min_length=2, max_length=2, description="[low, high]")]

    @model_validator(mode="after")
    def _ordered(self) -> Uniform:
        low, high = self.uniform
        if low > high:
            raise ValueError(f"the lower bound {low!r} is above the upper bound {high!r}")
        if not math.isfinite(high - low):
            raise ValueError(f"the bounds {low!r} and {high!r} are too far apart for floating-point numbers")
        return self


class Normal(Spec):
    """Drawn from the seed, normally distributed, one draw per element."""

    normal: Annotated[list[FiniteFloat], Field(min_length=2, max_length=2, description="[mean, standard deviation]")]

    @model_validator(mode="after")
    def _spread(self) -> Normal:
        if self.normal[1] < 0:
            raise ValueError(f"the standard deviation {self.normal[1]!r} is negative")
        return self


def _kind_of_start(value: Any) -> str | None:
    if isinstance(value, Uniform) or (isinstance(value, dict) and "uniform" in value):
        return "<uniform>"
    if isinstance(value, Normal) or (isinstance(value, dict) and "normal" in value):
        return "<normal>"
    if isinstance(value, list):
        return "<list>"
    return "<scalar>" if isinstance(value, (bool, int, float, str)) else None


if TYPE_CHECKING:
    StartValue: TypeAlias = Any  # mypy has no recursive alias of this kind
else:
    StartValue = TypeAliasType(
        "StartValue",
        Annotated[
            Annotated[Scalar, Tag("<scalar>")]
            | Annotated[Uniform, Tag("<uniform>")]
            | Annotated[Normal, Tag("<normal>")]
            | Annotated[list["StartValue"], Tag("<list>")],
            Discriminator(
                _kind_of_start,
                custom_error_type="start_value",
                custom_error_message="a start value is a number, true or false, text, a list of these, "
                "{uniform: [low, high]} or {normal: [mean, standard deviation]}",
            ),
        ],
    )


def _check_sha256(text: str) -> str:
    if not re.fullmatch(r"[0-9A-Fa-f]{64}", text):
        raise ValueError(f"{text!r} is no SHA-256; it has 64 hexadecimal digits, as `sha256sum FILE` prints them")
    return text.lower()


Sha256: TypeAlias = Annotated[
    str,
    AfterValidator(_check_sha256),
    WithJsonSchema({"type": "string", "pattern": "^[0-9A-Fa-f]{64}$"}),
]


class IsolationSpec(Spec):
    """How a component in a process of its own is watched."""

    deadline: PositiveDuration = Field(
        10_000_000_000,
        description="How long one call of it, such as a micro step, may take, in wall time; 10 s by default. Then its "
        "process is killed. To open and to initialise it has a minute, or this if that is longer.",
    )


def _isolation(value: Any) -> Any:
    return IsolationSpec() if value is True else None if value is False else value


class _OrBoolean:
    """In the JSON schema: or true or false."""

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {"anyOf": [{"type": "boolean"}, handler(schema)]}


class ComponentSpec(Spec):
    """One component of an agent: an FMU or a Python class."""

    fmu: str | None = Field(
        None,
        description="A shipped FMU by name (TwoLinkArm, TwoLinkArm.fmi2, TwoLinkArm.fmi3), or a file: anything that "
        "ends in .fmu or holds a '/', relative to this file.",
    )
    python: str | None = Field(None, description="A Python class that is a component: package.module:Class.")
    inputs: dict[str, MappedInput] = Field(
        {},
        description="Inputs under the names that the rest of the agent uses, each with the component's own behind it.",
    )
    outputs: dict[str, MappedOutput] = Field(
        {},
        description="Outputs under the names that the rest of the agent uses, each with the component's own behind it.",
    )
    start: dict[str, StartValue] = Field(
        {}, description="Start values and parameters by variable; one value fills a whole array."
    )

    sha256: Sha256 | None = Field(
        None,
        description="SHA-256 that the file must have, as `sha256sum` prints it; of a Python class, its source file's.",
    )

    step: PositiveDuration | None = Field(
        None,
        description="Its own micro step, which divides that of the coupling: between two exchanges with the others it "
        "makes several steps, its inputs held. For the couplings of Co-Simulation.",
    )
    isolate: Annotated[IsolationSpec | None, BeforeValidator(_isolation), _OrBoolean()] = Field(
        None,
        description="true: it runs in a process of its own, so that a crash, a hang or what it changes of its process "
        "hurts nothing else. Numbers stay the same; a micro step costs some 0.1 ms more.",
    )

    solver: Literal["cvode"] | None = Field(
        None,
        description="cvode: a component that offers Model Exchange is used as Co-Simulation, with CVODE inside; for "
        "stiff models, beside black boxes.",
    )
    tolerance: Annotated[float, Field(gt=0, lt=1)] | None = Field(
        None,
        description="Relative. With cvode: what it keeps to, by default 1e-8. Of an FMU in Co-Simulation: what its own "
        "solver is told, by default what its default experiment says.",
    )

    @model_validator(mode="after")
    def _one_kind(self) -> ComponentSpec:
        if self.fmu is not None and self.python is not None:
            raise ValueError("give either 'fmu' or 'python', not both")
        return self


# --- agents -----------------------------------------------------------------------------------------------------------


class CouplingSpec(Spec):
    """How the components of an agent are stepped together between two ticks."""

    method: Literal["auto", "joint", "midpoint", "gauss-seidel", "jacobi"] = Field(
        "auto",
        description="auto: joint where every component offers Model Exchange, else midpoint. "
        "joint: one integrator for all states. midpoint, gauss-seidel, jacobi: Co-Simulation.",
    )
    step: PositiveDuration | None = Field(
        None,
        description="Micro step; it divides the period. By default 5 ms for joint, else 1 ms or what an FMU asks for.",
    )
    integrator: Literal["euler", "rk4", "dormand-prince"] = Field(
        "rk4",
        description="For joint; dormand-prince adapts its step, euler (order 1) reproduces what other tools do.",
    )
    relative_tolerance: Annotated[float, Field(gt=0, lt=1)] = Field(1e-8, description="For dormand-prince.")
    absolute_tolerance: Annotated[float, Field(gt=0, lt=math.inf)] | None = Field(
        None, description="For dormand-prince, by default 1e-10; beside 'tolerance', by default as that."
    )
    tolerance: Annotated[float, Field(gt=0, lt=1)] | None = Field(
        None,
        description="Co-Simulation: steps as long as the estimated error of each in every output stays below "
        "this part of its size, plus absolute_tolerance; 'step' is then the largest, by default the period.",
    )
    least_step: PositiveDuration | None = Field(
        None, description="The shortest step that 'tolerance' may ask for; by default 1 us."
    )
    retries: Annotated[int, Field(ge=0, le=30)] = Field(
        0,
        description="Co-Simulation: how often a step that an FMU discards is tried again in halves, one into another. "
        "The FMUs must be able to save their state, and run in the Python loop.",
    )
    loop: Literal["native", "python"] | None = Field(
        None, description="Who runs the micro steps: compiled code (default where all components are FMUs) or Python."
    )


def _parse_connection(value: Any) -> Any:
    if not isinstance(value, str):
        raise ValueError("a connection is written 'component.output -> component.input'")  # noqa: TRY004 - pydantic's
    source, arrow, target = (part.strip() for part in value.partition("->"))
    if not arrow or not target or "->" in target:
        raise ValueError(f"{value!r} is no connection; write 'component.output -> component.input'")
    return (_check_reference(source), _check_reference(target))


ConnectionSpec: TypeAlias = Annotated[
    tuple[str, str],
    BeforeValidator(_parse_connection),
    WithJsonSchema(
        {"type": "string", "pattern": r"^\s*[^.\s]+\.\S.*->\s*[^.\s]+\.\S", "examples": ["plant.p -> controller.p"]}
    ),
]


class AgentSpec(Spec):
    """One agent, or several alike; also a template, and an entry that changes only some of it."""

    template: Name | None = Field(None, description="Name of the template that this agent starts from.")
    components: dict[ComponentName, ComponentSpec] = {}
    connections: list[ConnectionSpec] = Field([], description="Outputs that feed inputs of the same size.")
    publish: dict[str, Reference] = Field(
        {}, description="The message: its variables, and the output that each is read from at every tick."
    )
    receive: dict[str, Reference] = Field(
        {},
        description="Where the newest messages go, one row per in-neighbour: each variable of the message, and their "
        "stamp, time and weight; count and period name parameters that are set to |N_i| and T.",
    )
    record: list[Reference] | None = Field(None, description="What is recorded at every tick; every output by default.")
    coupling: CouplingSpec = CouplingSpec()


# --- network ----------------------------------------------------------------------------------------------------------


class _OrText:
    """In the JSON schema: or a text of a certain form."""

    def __init__(self, pattern: str, example: str) -> None:
        self._text = {"type": "string", "pattern": pattern, "examples": [example]}

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {"anyOf": [self._text, handler(schema)]}


class EdgeSpec(Spec):
    """Directed: the agents `to` can hear the agents `from`."""

    from_: Agents = Field(alias="from", description="Who sends: an agent, a range or a list.")
    to: Agents = Field(description="Who hears: an agent, a range or a list.")
    weight: Annotated[float, Field(gt=0, lt=math.inf)] | None = Field(None, description="a_ij; needs 'weights: given'.")
    channel: Name | None = Field(None, description="Name of a profile in 'channels'.")

    @model_validator(mode="before")
    @classmethod
    def _from_text(cls, value: Any) -> Any:
        if not isinstance(value, str):
            return value
        sender, arrow, receiver = (part.strip() for part in value.partition("->"))
        if not arrow or "->" in receiver:
            raise ValueError(f"{value!r} is no edge; write '4 -> 1' for: 1 can hear 4")
        return {"from": _check_agents(sender), "to": _check_agents(receiver)}


class ChannelRule(Spec):
    """The profile of the edges between some agents."""

    from_: AgentsOrAll = Field(ALL, alias="from", description="Who sends: an agent, a range, a list, or * for all.")
    to: AgentsOrAll = Field(ALL, description="Who hears: likewise.")
    channel: Name = Field(description="Name of a profile in 'channels'.")


class GraphSpec(Spec):
    """Who can hear whom."""

    weights: Literal["equal", "given"] = Field(
        "equal", description="equal: a_ij = 1 / number of in-neighbours of i. given: every edge has its weight."
    )
    channel: Name | None = Field(None, description="Profile of every edge that names none.")
    rules: list[ChannelRule] = Field(
        [], description="Profiles of edges that name none, by who sends and hears; the last rule that fits counts."
    )
    edges: list[Annotated[EdgeSpec, _OrText("->", "4 -> 1")]] = []


# --- analysis ---------------------------------------------------------------------------------------------------------


class AnalysisSpec(Spec):
    """What the report and `cosim check` call position, velocity and so on; none of it changes a run."""

    position: Reference | None = None
    velocity: Reference | None = None
    estimate: Reference | None = Field(None, description="Each agent's estimate of the common velocity.")
    parameters: Reference | None = Field(None, description="Each agent's estimate of its physical parameters.")
    reference_velocity: Annotated[list[FiniteFloat], Field(min_length=1)] | None = None
    leaders: dict[Reference, Scalar] = Field(
        {}, description="The agents with these start values are the leaders: {controller.role: leader}."
    )
    k_eta: Reference | None = Field(None, description="The parameter k_eta of the paper's synchronization term.")
    lambda_: Reference | None = Field(
        None, alias="lambda", description="The parameter lambda of the paper's synchronization term."
    )


# --- processes --------------------------------------------------------------------------------------------------------


def _check_worker(text: str) -> str:
    check_name(text, "worker")
    if text in RESERVED_PROCESSES:
        raise ValueError(f"no worker can be called {text!r}: another process of every run is")
    return text


WorkerName: TypeAlias = Annotated[str, BeforeValidator(_as_text), AfterValidator(_check_worker)]


def _kind_of_workers(value: Any) -> str | None:
    if isinstance(value, dict):
        return "<by name>"
    if isinstance(value, int) and not isinstance(value, bool):
        return "<number>"
    return "<word>" if isinstance(value, str) else None


WorkersSpec: TypeAlias = Annotated[
    Annotated[int, Field(ge=1), Tag("<number>")]
    | Annotated[Literal["per-agent"], Tag("<word>")]
    | Annotated[dict[WorkerName, Agents], Field(min_length=1), Tag("<by name>")],
    Discriminator(
        _kind_of_workers,
        custom_error_type="workers",
        custom_error_message="workers are a number, 'per-agent', or agents by worker: {lab-a: 1..5, lab-b: '6, 8..10'}",
    ),
]


# --- bridge -----------------------------------------------------------------------------------------------------------


def _check_key(text: str) -> str:
    unfilled = text.replace("{agent}", "a")
    if bad := next((character for character in "*$?#{}" if character in unfilled), None):
        hint = (
            "'{agent}' stands for the agent's name" if bad in "{}" else "it must be a single key, without any of *$?#"
        )
        raise ValueError(f"the key {text!r} has a {bad!r}; {hint}")
    if not unfilled.isprintable() or not all(unfilled.split("/")) or len(text) > _LONGEST_KEY:
        raise ValueError(f"{text!r} is no key; write words between single slashes, such as 'lab/{{agent}}/p'")
    first = unfilled.partition("/")[0]
    if first == "netcosim" or any(chunk.startswith("@") for chunk in unfilled.split("/")):
        raise ValueError(f"the key {text!r} is kept for Zenoh and for runs; begin it with another word")
    return text


_LONGEST_KEY = 1024
PlainKey: TypeAlias = Annotated[
    str,
    AfterValidator(_check_key),
    WithJsonSchema({"type": "string", "pattern": "^[^*$?#/]+(/[^*$?#/]+)*$", "examples": ["lab/{agent}/p"]}),
]


def _check_endpoint(text: str) -> str:
    protocol, slash, address = text.partition("/")
    if not slash or not address:
        raise ValueError(f"{text!r} is no endpoint of Zenoh; write 'tcp/127.0.0.1:7447'")
    if protocol not in _PROTOCOLS:
        raise ValueError(f"unknown protocol {protocol!r}{suggest(protocol, _PROTOCOLS)}")
    return text


_PROTOCOLS = ("tcp", "tls", "quic", "udp", "ws", "unixsock-stream", "vsock", "serial")
Endpoint: TypeAlias = Annotated[str, AfterValidator(_check_endpoint), WithJsonSchema({"type": "string"})]


class PublicationSpec(Spec):
    """A variable that others can read at every tick."""

    key: PlainKey = Field(description="Zenoh key; '{agent}' in it stands for the agent's name.")
    variable: Reference = Field(description="One of those that are recorded.")
    agents: Agents | None = Field(None, description="An agent, a range or a list; every agent by default.")
    encoding: Literal["json", "float64", "cdr"] = "json"


class SubscriptionSpec(Spec):
    """An input that others set: at every tick the newest value that has come, held until the next tick."""

    key: PlainKey = Field(description="Zenoh key; '{agent}' in it stands for the agent's name.")
    variable: Reference = Field(description="An input that nothing else feeds.")
    agents: Agents | None = Field(None, description="An agent, a range or a list; every agent by default.")
    start: StartValue | None = Field(
        None, description="The value until the first one comes; by default the component's own."
    )
    encoding: Literal["json", "float64", "cdr"] = "json"


class BridgeSpec(Spec):
    """What a run publishes for others on plain Zenoh keys, and takes from them; see docs/bridge.md."""

    publish: list[PublicationSpec] = []
    subscribe: list[SubscriptionSpec] = []
    listen: list[Endpoint] = Field(
        [], description="Where others connect; tcp/127.0.0.1:7447 if neither this nor connect is given."
    )
    connect: list[Endpoint] = Field([], description="Routers to connect to, such as tcp/192.168.0.7:7447.")
    insecure: bool = Field(
        False, description="Listen and connect beyond this host without TLS, where nobody else is on the network."
    )
    replay: str | None = Field(
        None, description="external.parquet of an earlier run, relative to this file, instead of the outside."
    )


# --- the whole --------------------------------------------------------------------------------------------------------


class ScenarioSpec(Spec):
    """A scenario: agents, who hears whom, and what the network does to every message."""

    name: Annotated[str, AfterValidator(scenario_name)] | None = Field(
        None, description="The file's name by default; runs are written to runs/<name>/."
    )
    title: str = ""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = Field(0, description="Of every random draw.")
    period: PositiveDuration = Field(description='T: the time between two ticks, such as "100 ms".')
    duration: PositiveDuration = Field(description="Simulated time, a multiple of the period.")
    templates: dict[str, AgentSpec] = {}
    agents: Annotated[dict[Agents, AgentSpec], Field(min_length=1)] = Field(
        description="Agents by name, range ('1..10') or list ('1, 4'); later entries are merged over earlier ones."
    )
    coupling: CouplingSpec = Field(CouplingSpec(), description="For every agent that does not say otherwise.")
    graph: GraphSpec = GraphSpec()
    channels: dict[str, AnyChannelModel] = Field(
        {}, description="What the network does to a message: by kind, or the name of a profile."
    )
    analysis: AnalysisSpec = AnalysisSpec()
    workers: WorkersSpec | None = Field(
        None,
        description="Of a run across processes: how many carry the agents ('per-agent': one each), or which agents "
        "each of them carries, by name. Results do not depend on it.",
    )
    bridge: BridgeSpec = BridgeSpec()
    on_worker_loss: Literal["abort", "restart"] = Field(
        "abort",
        description="Across processes, when a worker is killed, ends or hangs: abort ends the run; restart replaces "
        "it by a new process that does over what was lost, with the same results.",
    )


def json_schema() -> dict[str, Any]:
    """The JSON schema (draft 2020-12) of a scenario, for editors."""
    schema = ScenarioSpec.model_json_schema(by_alias=True)
    channels = schema["properties"]["channels"]  # a profile may stand there by its name: cosim.scenario.profiles
    named = {"type": "object", "properties": {"profile": {"type": "string"}}, "required": ["profile"]}
    channels["additionalProperties"] = {"anyOf": [channels["additionalProperties"], {"type": "string"}, named]}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "netcosim scenario"}
