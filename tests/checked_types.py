"""Types and shapes of every call within the package, looked at once.

jaxtyping's own wrapper binds each call to its signature and checks arguments twice, which is a
fifth of the suite's time. Here beartype checks them once, and then what is returned, within one
memory of shapes; functions without arrays need none.
"""

import functools
import inspect
import types
from collections.abc import Callable
from typing import Any, get_args

import jaxtyping
from beartype import BeartypeConf, beartype
from jaxtyping import AbstractArray, _decorator
from jaxtyping._storage import pop_shape_memo, push_shape_memo

_BY_JAXTYPING = jaxtyping.jaxtyped
_CONF = BeartypeConf(violation_type=jaxtyping.TypeCheckError)
_RESOLVED: dict[types.CodeType, dict[str, Any]] = {}


def install() -> None:
    """From now on the import hook's decorator is this one."""
    jaxtyping.jaxtyped = _decorator.jaxtyped = _jaxtyped


def _jaxtyped(fn: Any = None, *, typechecker: Any = None) -> Any:
    if fn is None:
        return functools.partial(_jaxtyped, typechecker=typechecker)
    if not isinstance(fn, types.FunctionType) or _is_strange(fn):
        return _BY_JAXTYPING(fn, typechecker=typechecker)
    if fn.__code__.co_filename == __file__:
        return fn  # a dataclass's own __init__, which comes twice
    return checked(fn)


def _is_strange(function: types.FunctionType) -> bool:
    """Generators, and dataclasses' own methods, whose defaults are no values."""
    code = function.__code__
    flags = inspect.CO_GENERATOR | inspect.CO_COROUTINE | inspect.CO_ASYNC_GENERATOR
    return bool(code.co_flags & flags) or code.co_filename == "<string>"


def checked(function: types.FunctionType) -> Callable[..., Any]:
    """The function, its arguments and what it returns checked against its annotations."""
    hints = _RESOLVED.setdefault(function.__code__, _resolved(function))
    with_types = _copy(function)
    with_types.__annotations__ = hints
    strict = beartype(conf=_CONF)(with_types)
    settings = jaxtyping.config

    if any(map(_holds_an_array, hints.values())):

        @functools.wraps(function)
        def wrapped(*args: Any, **kwargs: Any) -> Any:
            __tracebackhide__ = True
            if settings.jaxtyping_disable:
                return function(*args, **kwargs)
            push_shape_memo({})
            try:
                return strict(*args, **kwargs)
            finally:
                pop_shape_memo()

    else:

        @functools.wraps(function)
        def wrapped(*args: Any, **kwargs: Any) -> Any:
            __tracebackhide__ = True
            if settings.jaxtyping_disable:
                return function(*args, **kwargs)
            return strict(*args, **kwargs)

    return wrapped


def _copy(function: types.FunctionType) -> types.FunctionType:
    copy = types.FunctionType(
        function.__code__,
        function.__globals__,
        function.__name__,
        function.__defaults__,
        function.__closure__,
    )
    copy.__kwdefaults__ = function.__kwdefaults__
    copy.__qualname__, copy.__module__ = function.__qualname__, function.__module__
    return copy


def _resolved(function: types.FunctionType) -> dict[str, Any]:
    """Annotations without text; what is known to type checkers alone is not checked."""
    named = {
        name: _decorator._destring_annotation(hint, function.__globals__)
        for name, hint in function.__annotations__.items()
    }
    return {name: hint for name, hint in named.items() if hint is not Any}


def _holds_an_array(hint: Any) -> bool:
    if inspect.isclass(hint) and issubclass(hint, AbstractArray):
        return True
    return any(_holds_an_array(part) for part in get_args(hint))
