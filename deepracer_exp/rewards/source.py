"""The source of a reward function: find it, check it without running it, and set its constants."""

import ast
import hashlib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from deepracer_exp.config.driving import RewardConfig
from deepracer_exp.config.options import project_dir
from deepracer_exp.errors import BadInput, Unknown, nearest, reading
from deepracer_exp.files import read_bytes


@dataclass(frozen=True)
class RewardSource:
    """One reward function module, as text."""

    name: str
    path: str
    text: str
    sha256: str
    """Hash of the file's bytes, before constants are set."""
    constants: Mapping[str, int | float]
    """The tunable constants and their values in the file."""
    overrides: Mapping[str, int | float]
    """The values that replace them."""


def keeps_state(source: RewardSource) -> bool:
    """Return whether a function that a training calls changes a variable of its module, or an object in one."""
    module = ast.parse(source.text)
    functions = {node.name: node for node in module.body if isinstance(node, ast.FunctionDef)}
    called = [name for name in sorted(functions) if name in ("reward_batch", "reward_function")][:1]
    for name in called:  # and those that they name
        named = {node.id for node in ast.walk(functions[name]) if isinstance(node, ast.Name)}
        called += sorted(named & functions.keys() - {*called})
    bound = {
        node.name if isinstance(node, ast.ClassDef) else node.id
        for statement in module.body
        if not isinstance(statement, ast.FunctionDef)
        for node in ast.walk(statement)
        if isinstance(node, ast.ClassDef) or (isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store))
    }
    made = {name for statement in module.body for name in _made_of(statement)}
    methods = [
        node
        for statement in module.body
        if isinstance(statement, ast.ClassDef) and statement.name in made
        for node in statement.body
        if isinstance(node, ast.FunctionDef) and node.name != "__init__"
    ]
    return any(_changes(functions[name], bound) for name in called) or any(
        _changes(method, bound | {argument.arg for argument in method.args.args[:1]}) for method in methods
    )


_CHANGING = ("add", "append", "clear", "extend", "insert", "pop", "popleft", "remove", "setdefault", "update")
"""Methods that change a list, a set or a mapping."""


def _made_of(statement: ast.stmt) -> Iterator[str]:
    """Return the names of what a module's statement calls, outside functions and classes."""
    if not isinstance(statement, ast.FunctionDef | ast.ClassDef):
        for node in ast.walk(statement):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                yield node.func.id


def _changes(function: ast.FunctionDef, bound: Collection[str]) -> bool:
    """Return whether a function assigns to one of these names' values, or into one, or changes one by a method."""
    for node in ast.walk(function):
        if isinstance(node, ast.Global):
            return True
        stores = isinstance(node, ast.Attribute | ast.Subscript) and isinstance(node.ctx, ast.Store)
        calls = isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load) and node.attr in _CHANGING
        if stores or calls:
            root: ast.AST = node
            while isinstance(root, ast.Attribute | ast.Subscript):
                root = root.value
            if isinstance(root, ast.Name) and root.id in bound:
                return True
    return False


_ZOO = "reward_zoo"

NO_REWARD = RewardSource(
    name="none",
    path="none",
    text="def reward_function(params):\n    return 0.0\n\n\ndef reward_batch(params):\n    return params['x'] * 0.0\n",
    sha256="",
    constants={},
    overrides={},
)
"""Reward function of laps that are only timed: a run's own may no longer exist."""


def zoo_names() -> list[str]:
    """Return the names of the reward functions that come with the project, sorted."""
    return sorted(path.stem for path in project_dir(_ZOO).glob("*.py"))


def load_reward_source(config: RewardConfig) -> RewardSource:
    """Read the reward function that `config` names and check it without running it.

    Raises:
        BadInput: Unknown name; the file is missing, not a regular file, not UTF-8, not Python, without a
            `reward_function` of one argument; a constant that the module does not have.
    """
    if config.file is None:
        name, path, data = config.name, *_zoo_file(config.name)
    else:
        name, path, data = Path(config.file).stem, config.file, read_bytes(config.file, "a Python file")
    text = _decode(path, data)
    tree = _parse(path, text)
    _check_function(path, tree)
    constants = {constant: ast.literal_eval(value) for constant, value in _constants(tree)}
    for key in config.constants:
        if key not in constants:
            accepted = (
                ", ".join(constants) or "none; a constant is a line NAME = number with NAME in capitals"
            )
            why = f"{path} has no such constant{nearest(key.upper(), constants)}: {accepted}"
            raise Unknown(f"reward.constants.{key}", why)
    overrides = {key: _like(constants[key], value) for key, value in config.constants.items()}
    return RewardSource(name, path, text, hashlib.sha256(data).hexdigest(), constants, overrides)


def named_reward_source(reward: str) -> RewardSource:
    """Read a reward function of the zoo by its name, or any by its file; raises as `load_reward_source`."""
    is_file = reward not in zoo_names() and (reward.endswith(".py") or Path(reward).exists())
    file = reward if is_file else None
    return load_reward_source(RewardConfig(name=reward, file=file, constants={}, time_limit_s=1.0))


def source_with_constants(source: RewardSource) -> str:
    """Return the module's text with the overriding values in place; everything else is unchanged."""
    lines = source.text.encode().split(b"\n")
    replaced = [
        (value, source.overrides[name])
        for name, value in _constants(ast.parse(source.text))
        if name in source.overrides
    ]
    # From the last to the first, so that earlier positions stay valid.
    for node, value in reversed(replaced):
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        first, last = node.lineno - 1, node.end_lineno - 1
        before, after = lines[first][: node.col_offset], lines[last][node.end_col_offset :]
        lines[first : last + 1] = [before + repr(value).encode() + after]
    return b"\n".join(lines).decode()


def is_of_zoo(text: str) -> bool:
    """Return whether a module is one of the reward zoo, up to the values of its constants; nothing is run."""
    try:
        plain = _without_values("reward function", text)
    except BadInput:
        return False
    return any(plain == _without_values(name, _decode(*_zoo_file(name))) for name in zoo_names())


def _without_values(path: str, text: str) -> str:
    zeros = {name: 0 for name, _ in _constants(_parse(path, text))}
    return source_with_constants(RewardSource(path, path, text, "", {}, zeros))


def _zoo_file(name: str) -> tuple[str, bytes]:
    names = zoo_names()
    if name not in names:
        raise BadInput(
            "reward.name", f"{name!r} is not in the reward zoo{nearest(name, names)}: {', '.join(names)}"
        )
    file = project_dir(_ZOO) / f"{name}.py"
    return str(file), file.read_bytes()


def _decode(path: str, data: bytes) -> str:
    with reading(path, "a Python file"):
        text = data.decode("utf-8-sig")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _parse(path: str, text: str) -> ast.Module:
    before, null, _ = text.partition("\0")
    if null:  # the compiler names no line
        raise BadInput(path, f"line {before.count(chr(10)) + 1}: a null byte; this is not valid Python")
    try:
        # Compiling finds what parsing lets through, such as a `return` outside a function.
        compile(text, path, "exec", dont_inherit=True)
        return ast.parse(text, filename=path)
    except SyntaxError as error:
        raise BadInput(path, f"line {error.lineno}: {error.msg}; this is not valid Python") from error
    except (ValueError, RecursionError, MemoryError) as error:  # nesting too deep for the parser
        raise BadInput(path, f"is not valid Python: {error or 'too deeply nested'}") from error


def _check_function(path: str, tree: ast.Module) -> None:
    functions = {
        node.name: node for node in tree.body if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    }
    function = functions.get("reward_function")
    if function is None:
        assigned = {
            t.id for n in tree.body if isinstance(n, ast.Assign) for t in n.targets if isinstance(t, ast.Name)
        }
        # The service also accepts a callable object of that name; it is checked when the module is run.
        if "reward_function" not in assigned:
            hint = nearest("reward_function", functions)
            raise BadInput(path, f"has no function reward_function(params){hint}")
        return
    where = f"{path}: line {function.lineno}"
    if isinstance(function, ast.AsyncFunctionDef):
        raise BadInput(where, "reward_function must be a plain function, not an async one")
    for name in ("reward_function", "reward_batch"):
        candidate = functions.get(name)
        if candidate is not None and not _takes_one_argument(candidate.args):
            line = f"{path}: line {candidate.lineno}"
            raise BadInput(
                line, f"{name}({ast.unparse(candidate.args)}) must take one argument: {name}(params)"
            )


def _takes_one_argument(args: ast.arguments) -> bool:
    positional = len(args.posonlyargs) + len(args.args)
    required = positional - len(args.defaults)
    return required <= 1 and (positional >= 1 or args.vararg is not None) and None not in args.kw_defaults


def _constants(tree: ast.Module) -> Iterator[tuple[str, ast.expr]]:
    """Yield name and value node of every `NAME = number` at the top level of the module."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and len(node.targets) == 1:
            target, value = node.targets[0], node.value
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            target, value = node.target, node.value
        else:
            continue
        if isinstance(target, ast.Name) and target.id.isupper() and target.id[0] != "_" and _is_number(value):
            yield target.id, value


def _is_number(node: ast.expr) -> bool:
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
        node = node.operand
    return isinstance(node, ast.Constant) and type(node.value) in (int, float)


def _like(original: int | float, value: float) -> int | float:
    """Return a whole number as an int where the file has an int, so that `range(STEPS)` keeps working."""
    return int(value) if isinstance(original, int) and float(value).is_integer() else float(value)
