"""Conditions and formulas on case values: a small, safe part of Python's expressions.

Numbers, text, true and false, lists of them; names such as `link.modes`, `control.links[0]`;
`+ - * / **`, comparisons (also chained), `in`, `not in`, `and`, `or`, `not`, `abs`, `min`, `max`.
Everything is evaluated for all cases at once. Nothing else is accepted, so no code can be run.
"""

from __future__ import annotations

import ast
from collections.abc import Callable
from functools import reduce
from typing import Any

import numpy as np

from studies.errors import StudyError, shown
from studies.study.paths import NAMED_INDEX

#: A longer condition is rejected [characters].
LONGEST = 1000

Lookup = Callable[[str], np.ndarray]

_OPERATORS: dict[type, Callable[..., Any]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.Pow: lambda a, b: np.power(np.asarray(a, float), b),
    ast.USub: np.negative,
    ast.UAdd: np.positive,
    ast.Not: np.logical_not,
    ast.Lt: np.less,
    ast.LtE: np.less_equal,
    ast.Gt: np.greater,
    ast.GtE: np.greater_equal,
    ast.Eq: lambda a, b: np.asarray(a) == np.asarray(b),
    ast.NotEq: lambda a, b: np.asarray(a) != np.asarray(b),
}
_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "abs": np.abs,
    "min": lambda *x: reduce(np.minimum, x),
    "max": lambda *x: reduce(np.maximum, x),
}
_ALLOWED = (
    "numbers, text in quotes, names of fields, + - * / **, < <= > >= == !=, in, and, or, not, "
    "abs, min, max"
)


def evaluate(text: str, lookup: Lookup, field: str) -> np.ndarray:
    """Truth of a condition for every case.

    Args:
        text: the condition.
        lookup: values of a name for all cases, (n,); raises StudyError for an unknown one.
        field: where the condition is written, for messages.

    Returns:
        Booleans, (n,) or () if no name is used.

    Raises:
        StudyError: not a valid condition, or one that mixes text and numbers.
    """
    if len(text) > LONGEST:
        raise StudyError(f"{field}: {len(text)} characters; allowed: up to {LONGEST}")
    said = shown(text)
    try:
        tree = ast.parse(NAMED_INDEX.sub(r'["\1=\2"]', text.strip()), mode="eval").body
        with np.errstate(all="ignore"):
            value = np.asarray(_value(tree, lookup))
    except StudyError as error:
        raise StudyError(f"{field} = {said}: {error}") from None
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        reason = error.msg if isinstance(error, SyntaxError) else str(error)
        raise StudyError(
            f"{field} = {said}: not a condition ({reason}); allowed: {_ALLOWED}"
        ) from None
    except (TypeError, OverflowError):
        raise StudyError(f"{field} = {said}: mixes text and numbers") from None
    if value.dtype != bool:
        raise StudyError(f"{field} = {said}: gives no true or false; compare it with something")
    return value


def _value(node: ast.AST, lookup: Lookup) -> Any:
    if isinstance(node, ast.Constant) and isinstance(node.value, (bool, int, float, str)):
        return float(node.value) if type(node.value) is int else node.value
    if isinstance(node, (ast.Name, ast.Attribute, ast.Subscript)):
        name = _name(node)
        return name == "true" if name in ("true", "false") else lookup(name)
    if isinstance(node, (ast.UnaryOp, ast.BinOp)) and type(node.op) in _OPERATORS:
        sides = (node.operand,) if isinstance(node, ast.UnaryOp) else (node.left, node.right)
        return _OPERATORS[type(node.op)](*(_value(side, lookup) for side in sides))
    if isinstance(node, ast.BoolOp):
        join = np.logical_and if isinstance(node.op, ast.And) else np.logical_or
        return reduce(join, (_truth(value, lookup) for value in node.values))
    if isinstance(node, ast.Compare):
        return _comparison(node, lookup)
    if (
        isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id in _FUNCTIONS
        and node.args
        and not node.keywords
    ):
        return _FUNCTIONS[node.func.id](*(_value(item, lookup) for item in node.args))
    raise StudyError(f"{ast.unparse(node)!r} cannot be used here; allowed: {_ALLOWED}")


def _truth(node: ast.AST, lookup: Lookup) -> np.ndarray:
    value = np.asarray(_value(node, lookup))
    if value.dtype != bool:
        raise StudyError(f"{ast.unparse(node)!r} is neither true nor false")
    return value


def _comparison(node: ast.Compare, lookup: Lookup) -> np.ndarray:
    parts, left = [], node.left
    for operator, right in zip(node.ops, node.comparators, strict=True):
        if isinstance(operator, (ast.In, ast.NotIn)):
            if not isinstance(right, (ast.List, ast.Tuple)) or not right.elts:
                raise StudyError("'in' needs a list that is not empty, as in x in [1, 2]")
            value = _value(left, lookup)
            same = [np.asarray(value) == np.asarray(_value(each, lookup)) for each in right.elts]
            is_member = reduce(np.logical_or, same)
            parts.append(~is_member if isinstance(operator, ast.NotIn) else is_member)
        elif type(operator) in _OPERATORS:
            sides = _value(left, lookup), _value(right, lookup)
            _check_kinds(*sides)
            parts.append(_OPERATORS[type(operator)](*sides))
        else:
            raise StudyError(f"comparison in {ast.unparse(node)!r} cannot be used here")
        left = right
    return reduce(np.logical_and, parts)


def _check_kinds(a: Any, b: Any) -> None:
    if (np.asarray(a).dtype.kind in "UO") != (np.asarray(b).dtype.kind in "UO"):
        raise TypeError


def _name(node: ast.AST) -> str:
    """A dotted name with whole-number indices, as it is written."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        return f"{_name(node.value)}.{node.attr}"
    if isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Constant):
        if type(node.slice.value) is int:
            return f"{_name(node.value)}[{node.slice.value}]"
        if isinstance(node.slice.value, str):  # an index with the name of its axis
            return f"{_name(node.value)}[{node.slice.value}]"
    raise StudyError(f"{ast.unparse(node)!r} is not the name of a field")
