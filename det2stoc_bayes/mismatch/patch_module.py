"""Writes effects.py: the laws as they stand in the catalogue, and what calls them in a plain MuJoCo loop."""

import ast
import inspect
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from det2stoc_bayes.errors import ModelError
from det2stoc_bayes.mismatch import patch_contact
from det2stoc_bayes.mismatch import patch_forces as forces
from det2stoc_bayes.mismatch import patch_runtime as runtime
from det2stoc_bayes.mismatch.effects.base import Effect, PlacedEffect

Values = Mapping[str, float | int | str | Sequence[float] | np.ndarray]  # of an effect's parameters
MOST_SHOWN = 6  # numbers of a vector that are written out for a reader
WIDTH = 100  # of what is put on one line
CLOCK = "opt.timestep"  # an effect that changes it makes the recorded clock another than the simulation's
# Hook of an effect -> its table in effects.py, and the functions of the runtime that serve it.
_COLUMNS = ("measure", "given", "at_time", "arrays", "place_of")
_MIDDLE = ("lead_of", "remember_speed", "middle_speed", "follow")
_SERVED: dict[str, tuple[str, tuple[str, ...]]] = {
    "joint_force": ("JOINT_FORCES", ("add_joint_forces", "joint_and_actuators", "joint_state", "drive_of", *_MIDDLE)),
    "body_force": ("BODY_FORCES", ("add_body_forces", "body_state", "copy_state", *_MIDDLE)),
    "clock": ("CLOCKS", ("keep_clock",)),
    "momentary": (
        "MOMENTARY",
        (
            "rewrite_fields",
            "restore_fields",
            "set_field",
            "joint_and_actuators",
            "place_contact",
            "joint_state",
            *_MIDDLE,
            "drive_of",
        ),
    ),
    "control": ("CONTROLS", ("rewrite_controls", "follow")),
    "sample_time": ("SAMPLE_TIMES", ("remember_state", "follow")),
    "reading": ("READINGS", ()),
}
_STEPS = {
    "clock": ("keep_clock",),
    "control": ("rewrite_controls",),
    "momentary": ("remember_speed", "rewrite_fields"),
    "joint_force": ("remember_speed", "add_joint_forces"),
    "body_force": ("remember_speed", "add_body_forces"),
    "sample_time": ("remember_state",),
}
_ALWAYS_TABLES = ("sample_time", "reading", "clock")
_ALWAYS = ("Memory", "memory_of", "copy_state", *_COLUMNS)
_MEMORIES = "MEMORIES = WeakKeyDictionary()  # data object -> what is remembered of it"
_LOOP = """
    model = mujoco.MjModel.from_xml_path("patched.xml")
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel     # as recorded
    data.time = time                            # of that sample
    effects.reset(model, data)                  # after each reset of data
    while True:
        data.ctrl[:] = command                  # as recorded
        data.qfrc_applied[:] = 0
        data.xfrc_applied[:] = 0
        effects.control(model, data)            # before each step
        mujoco.mj_step(model, data)
        effects.measure(model, data, ["qpos/...", "sensor/..."])
"""


@dataclass(frozen=True)
class FieldWrite:
    """A field of mjModel that MJCF cannot express: its rows (empty for opt) and their values."""

    field: str
    rows: tuple[int, ...]
    values: object


def hooks_of(effect: Effect) -> tuple[str, ...]:
    """The hooks through which an effect acts in effects.py; a force that MJCF has a field for is none."""
    used = [h for h in _SERVED if (CLOCK in effect.changes if h == "clock" else effect.uses(h))]
    return tuple(h for h in used if not (h == "joint_force" and effect.changes))


def module_text(effects: Sequence[tuple[PlacedEffect, Values]], fields: Sequence[FieldWrite] = ()) -> str | None:
    """The text of effects.py, or None where the model's file says it all."""
    active = [(placed, values, hooks_of(placed.effect)) for placed, values in effects]
    hooks = [h for h in _SERVED if any(h in used for _, _, used in active)]
    if not hooks and not fields:
        return None
    laws = _Laws()
    tables: dict[str, list[str]] = {h: [] for h in _SERVED}
    constants = []
    for number, (placed, values, used) in enumerate((a for a in active if a[2]), 1):
        constants.append(_parameters(number, placed, values))
        for hook in used:
            tables[hook].append(_row(placed, values, hook, laws, f"P{number}"))
    parts = [
        _header(active, fields),
        "\n\n".join(["\n".join(_imports(hooks)), *constants, _MEMORIES]),
        *laws.sources.values(),
        "\n".join(_table(_SERVED[h][0], tables[h]) for h in _SERVED if h in (*hooks, *_ALWAYS_TABLES)),
        _fields_table(fields) if fields else "",
        "BELIEVED = WeakKeyDictionary()  # model -> fields before any step" if "momentary" in hooks else "",
        *_runtime_sources(hooks, bool(fields)),
        _reset("momentary" in hooks, bool(fields)),
        _control(dict.fromkeys(step for h, steps in _STEPS.items() if h in hooks for step in steps)),
    ]
    text = re.sub(r"\n{4,}", "\n\n\n", "\n\n\n".join(p.strip("\n") for p in parts if p)) + "\n"
    compile(text, "effects.py", "exec")
    return text


def _row(placed: PlacedEffect, values: Values, hook: str, laws: "_Laws", constants: str) -> str:
    """An effect's line in the table of a hook."""
    given = {name: np.asarray(value, float) for name, value in values.items()}
    if hook == "clock":
        return repr(float(1 / placed.effect.fields(given, {CLOCK: np.ones(())}, placed.element, np)[CLOCK]))
    row = [repr(_name(placed)), laws.add(placed.effect, hook), constants]
    if hook == "momentary":
        row = [repr(placed.element.kind), *row, repr(placed.effect.writes), repr(placed.effect.reads)]
    if hook == "body_force":
        row.insert(2, laws.add(placed.effect, "body_torque") if placed.effect.uses("body_torque") else "None")
    if hook == "joint_force":
        row.append(laws.beside(placed))
    if hook == "control":
        row.append(repr(placed.effect.memory(given)))
    line = ", ".join(row)
    return f"({line})" if len(line) < WIDTH else f"({''.join(f'\n        {cell},' for cell in row)}\n    )"


def _name(placed: PlacedEffect) -> str:
    """What the runtime looks an element up by; of a contact's geoms the one whose fields are rewritten comes last."""
    at = placed.element
    return "/".join(at.geom_names) or at.column or at.name


class _Laws:
    """The effects' own functions as plain ones, with the helpers they call."""

    def __init__(self):
        self.sources: dict[str, str] = {}

    def add(self, effect: Effect, hook: str) -> str:
        """Embeds a method; gives its name in effects.py."""
        name = f"{_snake(type(effect).__name__)}_{hook}"  # forms of an effect have laws of their own
        if name not in self.sources:
            self.sources[name] = ""  # a helper that calls it back finds it
            function = getattr(type(effect), hook)
            self.sources[name] = self._plain(function, name, effect)
        return name

    def beside(self, placed: PlacedEffect) -> str:
        """What a force on a joint needs beside its position, as a dictionary's text."""
        effect, source = placed.effect, placed.element.source
        given = {"driven": "True"} if "driven" in effect.needs else {}
        given |= {"anchor": self.add(effect, "anchor")} if effect.uses("anchor") else {}
        given |= {"source": repr(source), "reaction": self.add(effect, "reaction")} if source else {}
        return "{" + ", ".join(f'"{key}": {text}' for key, text in given.items()) + "}"

    def _plain(self, function: Callable, name: str, effect: Effect | None) -> str:
        function = inspect.unwrap(function)
        source = textwrap.dedent(inspect.getsource(function))
        if effect is not None:
            source = re.sub(r"^((?:@.*\n)*)def \w+\(self(, )?", rf"def {name}(", source, count=1)
            source = re.sub(r"\bself\.(\w+)", lambda m: self._own(effect, m[1]), source)
        tree = ast.parse(source)
        used = {node.id for node in ast.walk(_bare(tree)) if isinstance(node, ast.Name)}
        if used & {"self", "super", "cls"}:
            raise ModelError(f"effects.py: {name} needs its class for more than self.<name>; allowed: nothing else")
        for outside in sorted(used & set(function.__globals__)):
            self._outside(outside, function.__globals__[outside], name)
        return source if _is_bare(source) else ast.unparse(tree)

    def _own(self, effect: Effect, attribute: str) -> str:
        if callable(getattr(effect, attribute)):
            return self.add(effect, attribute)
        return repr(getattr(effect, attribute))

    def _outside(self, name: str, value: object, user: str) -> None:
        """What a law takes from around it: numpy, a function of ours, or a number."""
        if value is np or name in self.sources:
            return
        if inspect.isfunction(value):
            self.sources[name] = self._plain(value, name, None)
        elif isinstance(value, int | float | str | tuple):
            self.sources[name] = f"{name} = {value!r}"
        elif isinstance(value, np.ndarray):
            self.sources[name] = f"{name} = np.array({value.tolist()!r})"
        else:
            found = f"{user} uses {name}, which is {type(value).__name__}"
            raise ModelError(f"effects.py: {found}; allowed: functions, numbers, numpy as np")


def _snake(name: str) -> str:
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()


def _bare(tree: ast.Module) -> ast.Module:
    """The same without annotations: types of this package would not be found beside effects.py."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            node.returns = None
            for argument in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs):
                argument.annotation = None
    return tree


def _is_bare(source: str) -> bool:
    tree = ast.parse(source)
    return ast.dump(tree) == ast.dump(_bare(ast.parse(source)))


def _header(active: Sequence[tuple[PlacedEffect, Values, tuple[str, ...]]], fields: Sequence[FieldWrite]) -> str:
    lines = [f"What patched.xml cannot hold, for MuJoCo {mujoco.__version__}; needs mujoco and numpy.", ""]
    for number, (placed, values, _) in enumerate((a for a in active if a[2]), 1):
        lines.append(f"{number}. {placed.label}: {placed.effect.law_text}")
        lines += [f"   {text}" for text in parameter_texts(placed, values)]
    if fields:
        lines.append(f"Fields that MJCF cannot express, which reset writes: {', '.join(f.field for f in fields)}.")
    text = "\n".join([*lines, "", "Use:"]).replace("\\", "/").replace('"""', "'")
    return f'"""{text}\n{_LOOP}"""'


def _imports(hooks: Sequence[str]) -> list[str]:
    names = ["from types import SimpleNamespace"] if {"joint_force", "body_force", "momentary"} & set(hooks) else []
    return [*names, "from weakref import WeakKeyDictionary", "", "import mujoco", "import numpy as np"]


def _parameters(number: int, placed: PlacedEffect, values: Values) -> str:
    lines = [f"# {number}. {placed.label}: {placed.effect.law_text}", f"P{number} = {{"]
    for p in placed.effect.parameters:
        lines.append(f'    "{p.name}": {_literal(values[p.name])},  # {p.unit_on(placed.element)}')
    return "\n".join([*lines, "}"])


def parameter_texts(placed: PlacedEffect, values: Values) -> list[str]:
    """Each parameter for a reader, as `force = 0.31 N m`."""
    out = []
    for p in placed.effect.parameters:
        numbers = [f"{float(v):.4g}" for v in np.ravel(np.asarray(values[p.name]))]
        text = numbers[0] if np.ndim(values[p.name]) == 0 else f"({', '.join(numbers)})"
        if len(numbers) > MOST_SHOWN:
            low, high = np.min(np.asarray(values[p.name], float)), np.max(np.asarray(values[p.name], float))
            text = f"{len(numbers)} values from {low:.4g} to {high:.4g}"
        out.append(f"{p.name} = {text} {p.unit_on(placed.element)}")
    return out


def _literal(value: float | int | str | Sequence[float] | np.ndarray) -> str:
    if isinstance(value, str):
        return repr(value)
    numbers = np.asarray(value, dtype=float)
    if not numbers.ndim:
        return f"np.float64({float(numbers)!r})"
    line = repr(numbers.tolist())
    if len(line) < WIDTH // 2:
        return f"np.array({line})"
    return f"np.array(\n{textwrap.indent(textwrap.fill(line, WIDTH, break_on_hyphens=False), ' ' * 8)}\n    )"


def _table(name: str, rows: Sequence[str]) -> str:
    return f"{name} = (" + "".join(f"\n    {row}," for row in rows) + ("\n)" if rows else ")")


def _fields_table(fields: Sequence[FieldWrite]) -> str:
    return _table("FIELDS", [f"({f.field!r}, {f.rows!r}, {f.values!r})" for f in fields])


def _runtime_sources(hooks: Sequence[str], fields: bool) -> list[str]:
    served = {name for h in hooks for name in _SERVED[h][1]} | set(_ALWAYS) | ({"write_fields"} if fields else set())
    served |= {"field_of"} if fields or "momentary" in hooks else set()
    parts = (runtime, forces, patch_contact)
    members = [v for part in parts for v in vars(part).values() if getattr(v, "__module__", "") == part.__name__]
    return [inspect.getsource(m) for m in members if m.__name__ in served]


def _reset(momentary: bool, fields: bool) -> str:
    steps = [step for step, on in (("restore_fields", momentary), ("write_fields", fields)) if on]
    return inspect.getsource(runtime.reset) + "".join(f"    {step}(model)\n" for step in steps)


def _control(steps: Iterable[str]) -> str:
    doc = '    """Before each step, once ctrl is commanded and the applied forces are zeroed."""'
    return "\n".join(["def control(model, data):", doc, *(f"    {step}(model, data)" for step in steps)])
