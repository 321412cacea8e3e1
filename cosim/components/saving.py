"""What a Python component holds beside its variables, copied to be put back later: in memory, or as bytes."""

from __future__ import annotations

import copy
import io
import pickle
from collections.abc import Iterable, Mapping
from typing import Any

from numpy.typing import NDArray

_VALUES = "_values"


def attributes_of(component: object) -> dict[str, Any]:
    """All attributes of an instance, those in slots as well, but for the memory of its variables."""
    state: Any = object.__getstate__(component)
    found = {**(state[0] or {}), **state[1]} if isinstance(state, tuple) else dict(state or {})
    found.pop(_VALUES, None)
    return found


def put_back(component: object, attributes: Mapping[str, Any]) -> None:
    """These, and no others."""
    for name in attributes_of(component).keys() - attributes.keys():
        object.__delattr__(component, name)
    for name, value in attributes.items():
        object.__setattr__(component, name, value)


def copied(component: object, attributes: Mapping[str, Any]) -> dict[str, Any]:
    """A deep copy, in which references to the component itself and to the memory of its variables stay what they are.

    Raises:
        TypeError: an attribute cannot be copied, such as an open file; it is named.
    """
    if not attributes:
        return {}
    lasting = {id(thing): thing for thing in _lasting(component)}
    try:
        found: dict[str, Any] = copy.deepcopy(dict(attributes), dict(lasting))
    except Exception as error:
        raise TypeError(_culprit(attributes, lasting, error)) from None
    return found


def _culprit(attributes: Mapping[str, Any], lasting: Mapping[int, Any], error: Exception) -> str:
    for name, value in attributes.items():
        try:
            copy.deepcopy(value, dict(lasting))
        except Exception as own:
            return f"its attribute {name!r} cannot be copied ({own}); implement save and restore, or write save = None"
    return str(error)


# --- bytes ------------------------------------------------------------------------------------------------------------


def to_bytes(component: object, saved: object) -> bytes:
    """What was saved, for the same component or another instance of its class.

    Raises:
        Exception: something in it cannot be pickled.
    """
    file = io.BytesIO()
    _Pickler(file, _lasting(component)).dump(saved)
    return file.getvalue()


def from_bytes(component: object, data: bytes) -> Any:
    """What was saved, for this component. Like all of pickle, it trusts who wrote the bytes."""
    return _Unpickler(io.BytesIO(data), _lasting(component)).load()


class _Pickler(pickle.Pickler):
    """Writes the place of what lasts as long as the component, instead of the thing."""

    def __init__(self, file: io.BytesIO, lasting: Iterable[object]) -> None:
        super().__init__(file)
        self._places = {id(thing): place for place, thing in enumerate(lasting)}

    def persistent_id(self, obj: object) -> int | None:
        return self._places.get(id(obj))


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, lasting: Iterable[object]) -> None:
        super().__init__(file)
        self._things = list(lasting)

    def persistent_load(self, pid: Any) -> object:
        return self._things[pid]


def _lasting(component: object) -> list[object]:
    values: dict[str, NDArray[Any]] = getattr(component, _VALUES)
    return [component, values, *values.values()]
