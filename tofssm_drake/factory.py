"""Functions of a user's own, named in a scenario."""

from collections.abc import Callable, Mapping
import functools
import importlib
import inspect
import os
import sys
from types import ModuleType
from typing import Any

from tofssm_drake.errors import UserError, require


def import_here(name: str) -> ModuleType:
    """Imports a module, which may be in the current folder."""
    before = list(sys.path)
    sys.path.insert(0, os.getcwd())
    try:
        return importlib.import_module(name)
    finally:
        sys.path[:] = before


def find_factory(factory: str, *, where: str) -> Callable[..., Any]:
    """Returns the function that a scenario names.

    Args:
        factory: "package.module:function". Python looks for the module where it
            looks for all, and in the current folder.
        where: Path of keys, for the message.

    Raises:
        UserError: It is not of this form, or there is no such function.
    """
    module_name, colon, name = factory.partition(":")
    require(
        bool(module_name and colon and name.isidentifier()),
        f'{where}: {factory!r} must be "package.module:function"',
    )
    try:
        module = import_here(module_name)
    except (Exception, SystemExit) as error:
        missing = isinstance(error, ModuleNotFoundError) and error.name
        if missing and f"{module_name}.".startswith(f"{missing}."):
            raise UserError(
                f"{where}: there is no module {module_name!r}, neither "
                "installed nor in the current folder"
            ) from None
        raise UserError(
            f"{where}: {module_name} cannot be imported: {tell(error)}"
        ) from error
    function = getattr(module, name, None)
    if not callable(function):
        raise UserError(
            f"{where}: module {module_name!r} has no function {name!r}"
        )
    return function


def call_factory(
    factory: str, parameters: Mapping[str, Any], *, where: str, **given: Any
) -> Any:
    """Calls a user's function.

    Args:
        factory: See `find_factory`.
        parameters: Of the scenario.
        where: Path of keys to the choice, for the message.
        **given: Further arguments.

    Raises:
        UserError: There is no such function, it does not take these arguments,
            or it raises.
    """
    function = find_factory(factory, where=f"{where}.factory")
    try:
        inspect.signature(function).bind(**given, **parameters)
    except TypeError as error:
        raise UserError(
            f"{where}.parameters: {factory} does not take these: {error}"
        ) from None
    except ValueError:
        # Some built-in functions have no signature.
        pass
    try:
        return function(**given, **parameters)
    except UserError:
        raise
    except (Exception, SystemExit) as error:
        raise UserError(f"{where}: {factory}: {tell(error)}") from error


def tell(error: BaseException) -> str:
    """Returns an error in one line."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def call_factory_once(
    factory: str, parameters: Mapping[str, Any], *, where: str
) -> Any:
    """Calls a user's function; the next time returns the same.

    For what is asked at every scan or tick. Arguments as for `call_factory`.
    """
    # With types: 1 and 1.0 differ.
    given = tuple((k, v, type(v)) for k, v in sorted(parameters.items()))
    return _call_once(factory, given, where)


@functools.lru_cache(maxsize=32)
def _call_once(factory, given, where):
    parameters = {name: value for name, value, _ in given}
    return call_factory(factory, parameters, where=where)
