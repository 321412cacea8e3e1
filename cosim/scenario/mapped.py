"""How a scenario maps the variables of a component to the names that the rest of an agent uses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

from pydantic import AfterValidator, BaseModel, Discriminator, Field, Tag, WithJsonSchema, model_validator
from typing_extensions import TypeAliasType

from cosim.scenario.form import FORM


def _check_own(text: str) -> str:
    if not text.strip():
        raise ValueError("a variable's name is empty")
    return text.strip()


OwnVariable: TypeAlias = Annotated[
    str, AfterValidator(_check_own), WithJsonSchema({"type": "string", "examples": ["q1", "x[3]", "x[1,2]"]})
]
"""A variable of the component's own, or an element of one."""


def _one_or_several(value: Any) -> str | None:
    return "<list>" if isinstance(value, list) else "<text>" if isinstance(value, str) else None


if TYPE_CHECKING:
    OwnVariables: TypeAlias = Any  # mypy has no recursive alias of this kind
else:
    OwnVariables = TypeAliasType(
        "OwnVariables",
        Annotated[
            Annotated[OwnVariable, Tag("<text>")] | Annotated[list["OwnVariables"], Field(min_length=1), Tag("<list>")],
            Discriminator(
                _one_or_several,
                custom_error_type="own_variables",
                custom_error_message="write the name of a variable of the component, or a list of names",
            ),
        ],
    )


class Scaled(BaseModel):
    """What happens to values on their way."""

    model_config = FORM

    gain: Annotated[float, Field(allow_inf_nan=False)] | None = Field(
        None, description="Values are multiplied by it on their way; units are not converted then."
    )
    offset: Annotated[float, Field(allow_inf_nan=False)] | None = Field(
        None, description="Is added after the gain, on their way."
    )
    unit: str | None = Field(
        None,
        description="The unit for the rest of the agent: converted to or from the component's own where it has one.",
    )

    @model_validator(mode="after")
    def _reversible(self) -> Scaled:
        if self.gain == 0:
            raise ValueError("a gain of 0 leaves nothing; leave the variable out")
        return self


class ScaledOutput(Scaled):
    """Outputs of a component in other numbers: gain times what the component gives, plus offset."""

    from_: OwnVariables = Field(alias="from", description="The component's own.")


class ScaledInput(Scaled):
    """Inputs of a component in other numbers: the component gets gain times what it is sent, plus offset."""

    to: OwnVariables = Field(description="The component's own.")


def _kind_of_mapped(value: Any) -> str | None:
    return "<scaled>" if isinstance(value, (dict, Scaled)) else _one_or_several(value)


def _mapped_form(name: str, scaled: type[Scaled], key: str) -> Any:
    return TypeAliasType(
        name,
        Annotated[
            Annotated[OwnVariable, Tag("<text>")]
            | Annotated[list[name], Field(min_length=1), Tag("<list>")]  # type: ignore[valid-type]
            | Annotated[scaled, Tag("<scaled>")],
            Discriminator(
                _kind_of_mapped,
                custom_error_type="mapped",
                custom_error_message=f"write a variable of the component, {{{key}: variable, gain: 2}}, or a list",
            ),
        ],
    )


if TYPE_CHECKING:
    MappedOutput: TypeAlias = Any
    MappedInput: TypeAlias = Any
else:
    MappedOutput = _mapped_form("MappedOutput", ScaledOutput, "from")
    MappedInput = _mapped_form("MappedInput", ScaledInput, "to")
