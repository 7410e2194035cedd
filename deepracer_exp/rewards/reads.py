"""Which params a reward function reads, as far as its text says so.

What is not read need not be computed: lists about others cost as much as the rest of a step. A text that leaves any
doubt counts as one that reads everything.
"""

import ast
from collections.abc import Sequence

_LOOKS_AROUND = {"eval", "exec", "locals", "globals", "vars", "_getframe", "currentframe", "__dict__"}
"""Names by which a function could get at its params without naming them."""


def keys_read(text: str, name: str) -> frozenset[str] | None:
    """Return the keys of its params that a function of a module may read; None: it may read any.

    They are known where the function, and each function of the module to which it hands its params on, uses them only
    as `params["key"]`, `params.get("key")` and `"key" in params`.

    Args:
        text: of the module, valid Python.
        name: of the function.
    """
    tree = ast.parse(text)
    functions = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    names = [node.id for node in ast.walk(tree) if isinstance(node, ast.Name)]
    attributes = [node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)]
    if name not in functions or _LOOKS_AROUND.intersection([*names, *attributes]):
        return None
    bound = [bound for node in ast.walk(tree) for bound in _binds(node)]
    keys: set[str] = set()
    seen: set[tuple[str, int]] = set()
    waiting = [(name, 0)]
    while waiting:
        where = waiting.pop()
        if where in seen:
            continue
        seen.add(where)
        function, place = functions.get(where[0]), where[1]
        if function is None or function.decorator_list or bound.count(where[0]) != 1:
            return None
        parameters = [*function.args.posonlyargs, *function.args.args]
        if place >= len(parameters):
            return None
        uses = _uses(function, parameters[place].arg)
        if uses is None:
            return None
        keys |= uses[0]
        waiting += uses[1]
    return frozenset(keys)


def _binds(node: ast.AST) -> Sequence[str]:
    """Return the names to which a node of a module's text gives a value."""
    match node:
        case ast.Name(id=name, ctx=ast.Store()) | ast.arg(arg=name):
            return [name]
        case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
            return [name]
        case ast.alias(name=name, asname=other):
            return [other or name]
    return []


def _uses(function: ast.FunctionDef, params: str) -> tuple[set[str], Sequence[tuple[str, int]]] | None:
    """Return the keys that a function reads of its parameter, and functions with the place to which it hands it on."""
    keys: set[str] = set()
    handed: list[tuple[str, int]] = []
    understood: set[ast.expr] = set()
    for node in ast.walk(function):
        match node:
            case (
                ast.Subscript(value=ast.Name() as used, slice=ast.Constant(value=str(key)))
                | ast.Call(
                    func=ast.Attribute(value=ast.Name() as used, attr="get"),
                    args=[ast.Constant(value=str(key)), *_],
                )
                | ast.Compare(
                    left=ast.Constant(value=str(key)),
                    ops=[ast.In() | ast.NotIn()],
                    comparators=[ast.Name() as used],
                )
            ) if used.id == params:
                keys.add(key)
                understood.add(used)
            case ast.Call(func=ast.Name(id=called), args=arguments):
                # Behind a starred argument places are not known.
                for place, argument in enumerate(arguments):
                    if isinstance(argument, ast.Starred):
                        break
                    if isinstance(argument, ast.Name) and argument.id == params:
                        handed.append((called, place))
                        understood.add(argument)
    names = [node for node in ast.walk(function) if isinstance(node, ast.Name) and node.id == params]
    return (keys, handed) if understood.issuperset(names) else None
