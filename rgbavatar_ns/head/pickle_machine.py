"""The pickle machine without its dangers: opcodes build plain values and named stand-ins only."""

import codecs
import struct
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any

MAX_OPCODES = 500_000
"""Model files need thousands; this many take a second or two and 100 MB at most."""
_MAX_INTEGER_BYTES, _MAX_NUMBER_DIGITS = 64, 100
_KEYS = (str, bytes, int, float, type(None))
_MARK = object()


class RefusedPickleError(ValueError):
    """A pickle that is damaged or asks for something that is not on the list."""


class StandIn:
    """What a pickle's object becomes: it holds what it was given, and runs nothing."""

    def set_state(self, state: Any) -> None:
        """Take the state that the pickle carries; raises RefusedPickleError where it is odd."""
        raise RefusedPickleError(f"it gives a state to a {type(self).__name__}")


class Budget:
    """How many bytes and items may still be made; shared data used often is counted each time."""

    def __init__(self, max_bytes: int) -> None:
        self._left = max_bytes

    def spend(self, count: int) -> None:
        """Raises RefusedPickleError once more than allowed is asked for."""
        self._left -= count
        if self._left < 0:
            raise RefusedPickleError("its arrays claim more memory than a model file may hold")


class PickleGlobal:
    """An allowed name: calling it is our own code, never the code of that name."""

    def __init__(self, name: str, make: Callable[[Budget, tuple[Any, ...]], Any]) -> None:
        self.name = name
        self.make = make


class PickleMachine:
    """Reads pickles of all protocols from bytes, one after another.

    allowed: stand-ins by "module.name"; every other name is refused.
    persistent: makes a stand-in from a persistent id (torch storages); None refuses them.
    Only text, bytes, numbers and None can be keys, since hashing nested tuples can take for ever.
    """

    def __init__(
        self,
        data: bytes,
        allowed: Mapping[str, PickleGlobal],
        budget: Budget,
        persistent: Callable[[Any], StandIn] | None = None,
    ) -> None:
        self._data = data
        self._allowed = allowed
        self._budget = budget
        self._persistent = persistent
        self._opcodes_left = MAX_OPCODES
        self.place = 0
        """The next byte to read: after `load`, the one behind the pickle."""
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}

    def load(self) -> Any:
        """The next pickle's value, stand-ins unresolved; raises RefusedPickleError."""
        self._stack, self._memo = [], {}
        try:
            while True:
                self._opcodes_left -= 1
                if self._opcodes_left < 0:
                    raise RefusedPickleError(f"it has more than {MAX_OPCODES} steps")
                opcode = self._data[self.place]
                self.place += 1
                if opcode == 0x2E:
                    return self._pop()
                step = _STEPS.get(opcode)
                if step is None:
                    raise RefusedPickleError(f"it holds the opcode {opcode:#04x}, not needed here")
                step(self)
        except RefusedPickleError:
            raise
        except (
            ArithmeticError,
            AttributeError,
            IndexError,
            KeyError,
            TypeError,
            ValueError,
            struct.error,
        ) as error:
            raise RefusedPickleError(
                f"it is damaged near byte {self.place} ({type(error).__name__})"
            ) from None

    # Reading

    def take(self, count: int) -> bytes:
        """The next bytes; raises RefusedPickleError where there are not so many."""
        end = self.place + count
        if count < 0 or end > len(self._data):
            raise RefusedPickleError("it is cut short, or claims a length beyond its end")
        taken = self._data[self.place : end]
        self.place = end
        return taken

    def _number(self, form: str) -> Any:
        return struct.unpack(form, self.take(struct.calcsize(form)))[0]

    def _line(self) -> bytes:
        end = self._data.index(b"\n", self.place)
        taken = self._data[self.place : end]
        self.place = end + 1
        return taken

    def _digits(self) -> str:
        line = self._line()
        if len(line) > _MAX_NUMBER_DIGITS:
            raise RefusedPickleError("it holds a number of too many digits")
        return line.decode("ascii")

    # The stack

    def push(self, value: Any) -> None:
        """Put a value on the stack."""
        self._stack.append(value)

    def _pop(self) -> Any:
        value = self._stack.pop()
        if value is _MARK:
            raise RefusedPickleError("its stack is out of order")
        return value

    def _pop_to_mark(self) -> list[Any]:
        items = []
        while (value := self._stack.pop()) is not _MARK:
            items.append(value)
        return items[::-1]

    def _top(self, kind: type) -> Any:
        if not isinstance(self._stack[-1], kind):
            raise RefusedPickleError("its containers are out of order")
        return self._stack[-1]

    def _remember(self, key: int) -> None:
        if self._stack[-1] is _MARK:
            raise RefusedPickleError("its stack is out of order")
        self._memo[key] = self._stack[-1]

    # Containers

    def _set_items(self, items: list[Any]) -> None:
        target = self._top(dict)
        for key, value in pairs(items):
            target[key] = value

    def _append(self, items: list[Any]) -> None:
        self._top(list).extend(items)

    def _add(self, items: list[Any]) -> None:
        self._top(set).update(checked_keys(items))

    def _dict(self) -> None:
        self.push(dict(pairs(self._pop_to_mark())))

    def _tuple(self, count: int) -> None:
        items = [self._pop() for _ in range(count)]
        self.push(tuple(items[::-1]))

    # Names and objects

    def _global(self, module: str, name: str) -> None:
        full = f"{module}.{name}"
        if full not in self._allowed:
            shown = full if full.isprintable() and len(full) < 120 else ascii(full)[:120]
            raise RefusedPickleError(f"it asks for {shown}, which is not on the list")
        self.push(self._allowed[full])

    def _stack_global(self) -> None:
        name, module = self._pop(), self._pop()
        if not isinstance(name, str) or not isinstance(module, str):
            raise RefusedPickleError("it asks for a name that is no text")
        self._global(module, name)

    def _call(self) -> None:
        arguments, function = self._pop(), self._pop()
        if not isinstance(function, PickleGlobal) or not isinstance(arguments, tuple):
            raise RefusedPickleError("it calls something that is not on the list")
        self.push(function.make(self._budget, arguments))

    def _build(self) -> None:
        state = self._pop()
        target = self._stack[-1]
        if isinstance(target, StandIn):
            target.set_state(state)
        elif not isinstance(target, OrderedDict):
            # torch gives state dictionaries a `_metadata` attribute, which nobody here reads.
            raise RefusedPickleError(f"it gives a state to a {type(target).__name__}")

    def _persistent_id(self) -> None:
        if self._persistent is None:
            raise RefusedPickleError("it refers to data outside of it")
        self.push(self._persistent(self._pop()))

    def _long(self, size: int) -> None:
        if not 0 <= size <= _MAX_INTEGER_BYTES:
            raise RefusedPickleError("it holds a number of too many digits")
        self.push(int.from_bytes(self.take(size), "little", signed=True))

    def _text_integer(self) -> None:
        digits = self._digits()
        self.push({"00": False, "01": True}[digits] if digits in ("00", "01") else int(digits, 0))


def checked_keys(items: list[Any]) -> list[Any]:
    """The items, if all can be hashed at once; raises RefusedPickleError."""
    for item in items:
        if not isinstance(item, _KEYS):
            raise RefusedPickleError(f"it uses a {type(item).__name__} as a key")
    return items


def pairs(items: list[Any]) -> list[tuple[Any, Any]]:
    """Keys and values that follow one another; raises RefusedPickleError."""
    if len(items) % 2:
        raise RefusedPickleError("its containers are out of order")
    return list(zip(checked_keys(items[::2]), items[1::2]))


def _quoted(line: bytes) -> str:
    """A Python 2 string literal as text of one character a byte."""
    line = line.strip()
    if len(line) < 2 or line[:1] not in (b"'", b'"') or line[:1] != line[-1:]:
        raise RefusedPickleError("it holds a text without quotes")
    return codecs.escape_decode(line[1:-1])[0].decode("latin-1")  # pyright: ignore


_Step = Callable[[PickleMachine], Any]


def _steps() -> dict[int, _Step]:
    """What each opcode does (pickletools describes them); those not needed are absent."""
    machine = PickleMachine
    constants: dict[bytes, Callable[[], Any]] = {
        b"N": lambda: None,
        b"\x88": lambda: True,
        b"\x89": lambda: False,
        b"(": lambda: _MARK,
        b")": tuple,
        b"]": list,
        b"}": dict,
        b"\x8f": set,
    }
    steps: dict[bytes, _Step] = {
        code: lambda m, make=make: m.push(make()) for code, make in constants.items()
    }
    for code, form in ((b"J", "<i"), (b"K", "<B"), (b"M", "<H"), (b"G", ">d")):
        steps[code] = lambda m, form=form: m.push(m._number(form))
    # Python 2 strings are read as Latin-1, one character a byte.
    for code, form, decode in (
        (b"T", "<i", "latin-1"),
        (b"U", "<B", "latin-1"),
        (b"X", "<I", "utf-8"),
        (b"\x8c", "<B", "utf-8"),
        (b"\x8d", "<Q", "utf-8"),
    ):
        steps[code] = lambda m, form=form, decode=decode: m.push(
            m.take(m._number(form)).decode(decode, "strict")
        )
    for code, form in ((b"B", "<I"), (b"C", "<B"), (b"\x8e", "<Q"), (b"\x96", "<Q")):
        steps[code] = lambda m, form=form: m.push(m.take(m._number(form)))
    for code, count in ((b"\x85", 1), (b"\x86", 2), (b"\x87", 3)):
        steps[code] = lambda m, count=count: m._tuple(count)
    steps |= {
        b"\x80": lambda m: m._number("<B"),
        b"\x95": lambda m: m._number("<Q"),
        b"0": lambda m: m._stack.pop(),
        b"1": lambda m: m._pop_to_mark(),
        b"2": lambda m: m.push(m._top(object)),
        b"F": lambda m: m.push(float(m._digits())),
        b"I": machine._text_integer,
        b"L": lambda m: m.push(int(m._digits().rstrip("L"), 10)),
        b"\x8a": lambda m: m._long(m._number("<B")),
        b"\x8b": lambda m: m._long(m._number("<i")),
        b"S": lambda m: m.push(_quoted(m._line())),
        b"V": lambda m: m.push(m._line().decode("raw-unicode-escape")),
        b"a": lambda m: m._append([m._pop()]),
        b"e": lambda m: m._append(m._pop_to_mark()),
        b"s": lambda m: m._set_items([m._pop(), m._pop()][::-1]),
        b"u": lambda m: m._set_items(m._pop_to_mark()),
        b"\x90": lambda m: m._add(m._pop_to_mark()),
        b"\x91": lambda m: m.push(frozenset(checked_keys(m._pop_to_mark()))),
        b"d": machine._dict,
        b"l": lambda m: m.push(m._pop_to_mark()),
        b"t": lambda m: m.push(tuple(m._pop_to_mark())),
        b"g": lambda m: m.push(m._memo[int(m._digits())]),
        b"h": lambda m: m.push(m._memo[m._number("<B")]),
        b"j": lambda m: m.push(m._memo[m._number("<I")]),
        b"p": lambda m: m._remember(int(m._digits())),
        b"q": lambda m: m._remember(m._number("<B")),
        b"r": lambda m: m._remember(m._number("<I")),
        b"\x94": lambda m: m._remember(len(m._memo)),
        b"c": lambda m: m._global(m._line().decode("utf-8"), m._line().decode("utf-8")),
        b"\x93": machine._stack_global,
        b"R": machine._call,
        b"\x81": machine._call,
        b"b": machine._build,
        b"Q": machine._persistent_id,
    }
    return {code[0]: step for code, step in steps.items()}


_STEPS = _steps()
