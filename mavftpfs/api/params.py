"""A vehicle's parameters for programs: a mapping of names to numbers. Layer: api."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from numbers import Integral, Real

from mavftpfs.client import parameters as client
from mavftpfs.client.files import Session
from mavftpfs.client.progress import Progress
from mavftpfs.parameters.values import Kind, Parameter
from mavftpfs.shared.errors import NotTaken, UsageError

Number = int | float


async def get_values(session: Session) -> dict[str, Number]:
    """Return all parameters, in the vehicle's order.

    Raises:
        As client.parameters.read_parameters.
    """
    return {one.name: _number(one) for one in await client.read_parameters(session)}


def _number(one: Parameter) -> Number:
    """Return a value; a 32-bit float as its shortest decimal: 0.1, not 0.10000000149."""
    text = client.value_text(one)
    return float(text) if one.kind is Kind.FLOAT else int(text)


def _text(name: str, value: Number) -> str:
    """Return a number as text; also takes numpy's numbers."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise UsageError(f"{name} is a number, not {value!r}")
    return repr(int(value) if isinstance(value, Integral) else float(value))


async def set_values(session: Session, values: Mapping[str, Number]) -> None:
    """Set parameters, and read each one back. Values that the vehicle already has are not sent.

    Raises:
        UsageError: the vehicle does not have a name, or a value is not a number; nothing is set.
        InvalidText: a value does not fit; nothing is set. NotTaken: the vehicle did not accept some; the text
            names them.
    """
    lines = client.assignments([f"{name}={_text(name, value)}" for name, value in values.items()])
    plan = client.plan_changes(lines, await client.read_parameters(session), "", meant=True)
    if plan.unknown:
        raise UsageError(f"no parameter is called {', '.join(line.name for line in plan.unknown)}")
    if not plan.changes:
        return
    try:
        await client.set_values(session, plan.changes, Progress())
    except NotTaken as exc:
        raise NotTaken("; ".join(await client.last_error(session)) or str(exc)) from exc


class Params(Mapping[str, Number]):
    """The parameters of a Drone, read at the first use. Each `drone.params` is a new object, which reads them
    again. Setting one, or several by `update`, returns when the new values have been read back.
    """

    def __init__(
        self, read: Callable[[], dict[str, Number]], write: Callable[[Mapping[str, Number]], None]
    ) -> None:
        self._read = read
        self._write = write
        self._seen: dict[str, Number] | None = None

    def _all(self) -> dict[str, Number]:
        if self._seen is None:
            self._seen = self._read()
        return self._seen

    def __getitem__(self, name: str) -> Number:
        """Return a value. Raises KeyError."""
        return self._all()[name]

    def __setitem__(self, name: str, value: Number) -> None:
        """Set a value; see update."""
        self.update({name: value})

    def __iter__(self) -> Iterator[str]:
        """Yield the names, in the vehicle's order."""
        return iter(self._all())

    def __len__(self) -> int:
        """Return the number of parameters."""
        return len(self._all())

    def update(self, values: Mapping[str, Number]) -> None:
        """Set several parameters at once.

        Raises:
            UsageError (a ValueError), OSError of EINVAL: a name or value is invalid, and nothing is set.
            OSError: the vehicle did not accept some, and the text names them; EROFS: it is armed.
        """
        self._seen = None
        self._write(values)
