"""Functions of a user's own, named in a scenario."""

from collections.abc import Callable
import importlib
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
        factory: "package.module:function".
        where: Path of keys, for the message.

    Raises:
        UserError: It is not of this form, or there is no such function.
    """
    module_name, _, name = factory.partition(":")
    require(
        bool(module_name and name),
        f'{where}: {factory!r} must be "package.module:function"',
    )
    try:
        module = import_here(module_name)
    except ImportError as error:
        raise UserError(
            f"{where}: cannot import {factory!r}: {error}"
        ) from error
    function = getattr(module, name, None)
    if not callable(function):
        raise UserError(f"{where}: {module_name} has no function {name!r}")
    return function


def call_factory(
    factory: str, parameters: dict[str, Any], *, where: str, **given: Any
) -> Any:
    """Calls a user's function.

    Args:
        factory: "package.module:function".
        parameters: Of the scenario.
        where: Path of keys to the choice, for the message.
        **given: Further arguments.

    Raises:
        UserError: There is no such function, or it raises.
    """
    function = find_factory(factory, where=f"{where}.factory")
    try:
        return function(**given, **parameters)
    except UserError:
        raise
    except Exception as error:
        raise UserError(
            f"{where}: {factory}: {type(error).__name__}: {error}"
        ) from error
