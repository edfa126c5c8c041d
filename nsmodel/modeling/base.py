"""What the seven model classes share: time, parameters, names, the conversion of what the user wrote, and its checks.

What ``help`` says of a class of models: its own arguments and those of all classes, in its docstring and its signature.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, ClassVar, Self
from weakref import WeakValueDictionary

import casadi as ca
import numpy as np

from nsmodel._utils import check_keywords, did_you_mean, html_repr, one_line
from nsmodel.errors import ModelError, UsageError
from nsmodel.modeling.conversion import Converter, declare
from nsmodel.modeling.description import describe_model
from nsmodel.modeling.expressions import check_defined, check_finite
from nsmodel.modeling.inputs import DeclaredInputs, Signals
from nsmodel.modeling.laws import StateNames
from nsmodel.modeling.outputs import SampledExactState, declare_outputs
from nsmodel.modeling.parameters import (
    RESERVED_RUN_NAMES,
    Values,
    check_grid_arguments,
    check_switch_times,
    declare_parameters,
    named_expressions,
    numbered_row_names,
    read_units,
    scalar_values,
    state_names_and_stems,
    substitute_in_model,
)
from nsmodel.modeling.pickling import Picklable, deep_copies, is_plain
from nsmodel.proof.expression_graph import TRUTH_VALUED_OPERATIONS

ATTRIBUTES_HEADING = "Attributes:\n"


def add_common_arguments(own: str | None, common: str | None) -> str | None:
    """The docstring of a class with the arguments of all classes behind its own; None where docstrings are left out."""
    if not own or not common or ATTRIBUTES_HEADING not in own or ATTRIBUTES_HEADING not in common:
        return own
    shared = common.partition(ATTRIBUTES_HEADING)[2].partition("\n\n")[0].rstrip()
    before, _, rest = own.partition(ATTRIBUTES_HEADING)
    attributes, gap, after = rest.partition("\n\n")
    return f"{before}{ATTRIBUTES_HEADING}{attributes.rstrip()}\n{shared}\n{gap[1:]}{after}"


class OwnArgumentsFirst:
    """The signature of a dataclass: the arguments of its own before those that it inherits, without defaults that say nothing."""

    def __get__(self, made: Any, owner: type) -> inspect.Signature:
        """Return it for ``inspect.signature``, which asks the class."""
        given = inspect.signature(owner.__init__)
        fields = {field.name: field for field in dataclasses.fields(owner)}
        own = {name for name in vars(owner).get("__annotations__", {}) if name in given.parameters}
        parameters = []
        for name, parameter in list(given.parameters.items())[1:]:
            made_new = fields[name].default_factory if name in fields else dataclasses.MISSING
            parameters.append(parameter if made_new is dataclasses.MISSING else parameter.replace(default=made_new()))
        parameters.sort(key=lambda parameter: parameter.name not in own)
        return given.replace(parameters=parameters)


ARRAYS_WITH_UNITS = frozenset("x gap_min pressure contact_reaction".split())  # Further arrays that may have a unit.
KINK_PREFIXES = "potential ", "phi "  # What the names of a potential's kinks begin with.
MOVE_TERM_HINT = "move that term elsewhere"
INPUT_FREE_USES = frozenset({"certificate", "--certificate"})  # What models with inputs have no place in.
GIVEN_FIELDS = "given fields"  # The name, in pickles of models, of what they were given.
LEFT_OUT: Any = None  # A field that may be left out, and has its type once the model is declared.


@dataclass(frozen=True, eq=False)
class _GivenFields:
    """What a model of a class was given, and what became of it, by the names of its fields."""

    of: type
    given: Mapping[str, Any]
    declared: Mapping[str, Any]


# By the id of its time symbol: `dataclasses.replace` hands it on with all that was declared, of which names may be gone.
_declarations: WeakValueDictionary[int, _GivenFields] = WeakValueDictionary()


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Model(Picklable):
    """Arguments of all classes.

    Attributes:
        t: the time symbol, where an expression uses it.
        t_end: end of the run, > 0 (it starts at 0).
        step: the time step h > 0, constant; or
        steps: the time steps h_0, h_1, ...: a sequence of numbers > 0 (then ``t_end`` is their sum).
        switch_times: known times, >= 0 and increasing, at which the data has an edge (a table's point, a force that is switched
            on): steps under error control, and pieces, end there; constant steps stay where they are.
        scheme: the formula of a time step, one of the class's ``schemes``; the first where left out.
        parameters: {symbol or name: value}, a list or array for a vector or matrix of symbols; a value of None must be given
            when the model is run. After construction {name: value} of each scalar.
        inputs: {symbol or name: signal}, what drives the model from outside: `table`, `pwm`, `steps`, `signal`, a number, an
            expression of t; a list for a vector of symbols; None: given when the model is run. They may stand wherever time may.
        blocks: controllers, switches and latches, `sampled`, `each_step` and what is made of them: what they hold may stand
            wherever inputs may, and be the duty of a `pwm`.
        outputs: {name: expression}, further columns of runs, each a scalar or a column of expressions of t, states, inputs,
            parameters and what else runs have (see `docs/guide.md`): multipliers by their names, or all as ``l``, and ``y``.
        names: one name for each state, where the symbols' own are not wanted.
        units: {name: unit} for states, multipliers and "t"; used by pictures and tables.
        exact: the exact state, where known: a callable t (N,) -> (N, n), or n expressions of ``t``.
        title: one line for pictures and tables.

    After construction every expression is a CasADi SX in the symbols ``t``, the state and ``p`` (the parameters without a value
    yet bound, in the order of ``parameters``), and there are

        stems: {name: indices of its states} of each vector of states, and of each state that stands alone.
        vectors: {name: names of its entries} of each vector and matrix among the parameters.
        u: the symbols of the inputs (nu, 1); input_groups: {name of an input: names of its entries}, in that order.
        bound_parameters: {name: value} of the parameters that `bind` replaced.

    ``dataclasses.replace(model, x0=[1])`` is the model made of what was given, with these arguments in place of its own.
    """

    t: Any = LEFT_OUT
    t_end: float = LEFT_OUT
    step: float | None = None
    steps: Sequence[float] | None = None
    switch_times: Sequence[float] = ()
    scheme: str = ""
    parameters: Values = field(default_factory=dict)
    inputs: Signals = field(default_factory=dict)
    blocks: Any = ()
    outputs: Mapping[str, Any] = field(default_factory=dict)
    names: Sequence[str] = LEFT_OUT
    units: Mapping[str, str] = field(default_factory=dict)
    exact: Any = None
    title: str = ""

    __slots__ = ("_declaration",)  # No part of what the model is: neither pickled nor compared.

    p: ca.SX = field(init=False, repr=False)
    u: ca.SX = field(init=False, repr=False, default=ca.SX(0, 1))
    input_groups: Mapping[str, tuple[str, ...]] = field(init=False, repr=False, default_factory=lambda: MappingProxyType({}))
    stems: Mapping[str, Sequence[int]] = field(init=False, repr=False)
    vectors: Mapping[str, np.ndarray] = field(init=False, repr=False)
    bound_parameters: Mapping[str, float] = field(init=False, repr=False, default_factory=lambda: MappingProxyType({}))

    paper: ClassVar[str]
    schemes: ClassVar[tuple[str, ...]]
    letter: ClassVar[str] = "x"  # Of the state: its symbols are model.x, its start is model.x0.
    has: ClassVar[Mapping[str, str]] = {}  # What a run of the class has beside those of all classes: {name: in words}.
    gaps: ClassVar[bool] = False  # Whether y of a run is by how much constraints are kept.
    second_order: ClassVar[bool] = False  # Whether what moves is x with its velocity v, a column of runs.
    law_descriptions: ClassVar[
        Mapping[str, tuple[str, StateNames]]
    ] = {}  # What laws are called in the class, and its words for their states.
    refuses: ClassVar[Mapping[str, str]] = {}  # What is not done with a model of the class: {what: why, and what to do instead}.
    unblocked: ClassVar[str] = ""  # Why models of the class take no blocks, and what to do instead.
    outputless: ClassVar[str] = ""  # Why models of the class declare no outputs, and what to do instead.
    of_time: ClassVar[str] = MOVE_TERM_HINT  # What to do with time where it may not stand.

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.__doc__ = add_common_arguments(cls.__doc__, Model.__doc__)

    def __new__(cls, *_: Any, **given: Any) -> Self:
        """Refuse a keyword that is none, with what is near."""
        if given:  # a copy has none
            check_keywords(cls.__name__, given, inspect.signature(cls.__init__).parameters)
        return super().__new__(cls)

    __signature__ = OwnArgumentsFirst()
    __repr__ = describe_model
    _repr_html_ = html_repr("model_html")

    def __post_init__(self) -> None:
        """Check and convert what was given, anew where `dataclasses.replace` hands on what was converted."""
        names = [field.name for field in dataclasses.fields(self) if field.init]
        known = _declarations.get(id(self.t))
        if known is not None and self._replaces(known):
            converted = [name for name in names if name in known.declared and getattr(self, name) is known.declared[name]]
            self._set(
                **{name: known.given[name] for name in converted if not isinstance(getattr(self, name), int | float | str | None)}
            )
        given = {name: getattr(self, name) for name in names}
        self._set(scheme=self._chosen_scheme())
        self._declare()
        self._set(outputs=MappingProxyType(declare_outputs(self.outputs, self)))
        self._check_units()
        self._remember(given)

    def _remember(self, given: Mapping[str, Any]) -> None:
        """Keep what was given, for `dataclasses.replace`."""
        declaration = _GivenFields(type(self), given, {name: getattr(self, name) for name in given})
        self._set(_declaration=declaration)
        _declarations[id(self.t)] = declaration

    def _replaces(self, known: _GivenFields) -> bool:
        """Whether `dataclasses.replace` makes this model: each argument is handed on or given anew, none is left out."""
        return type(self) is known.of and all(
            getattr(self, one.name) is known.declared[one.name] or getattr(self, one.name) is not one.default
            for one in dataclasses.fields(self)
            if one.init
        )

    def __copy__(self) -> Self:
        """Copy the model, not its parts."""
        other = super().__copy__()
        if (known := getattr(self, "_declaration", None)) is not None:
            other._set(_declaration=known)
        return other

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Copy the model and its parts, but for functions and symbols."""
        other = super().__deepcopy__(memo)
        with suppress(Exception):  # Whatever an object of the user's raises: the model is copied, without it.
            if given := deep_copies(self._given_fields(), memo):
                other._remember(given)
        return other

    def __getstate__(self) -> dict[str, Any]:
        """What is pickled of it: with what it was given, where that can be."""
        given = self._given_fields()
        return super().__getstate__() | ({GIVEN_FIELDS: given} if given and is_plain(given) else {})

    def _given_fields(self) -> dict[str, Any]:
        """What it was given, by field; what was changed since, as by `bind`, as it is now."""
        known = getattr(self, "_declaration", None)
        if known is None:
            return {}
        now = {name: getattr(self, name) for name in known.given}
        return {name: known.given[name] if value is known.declared[name] else value for name, value in now.items()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take up what was pickled."""
        given = state.pop(GIVEN_FIELDS, None)
        vars(self).update(state)
        if given is not None:
            self._remember(given)

    def _declare(self) -> None:
        raise NotImplementedError

    def _chosen_scheme(self) -> str:
        if not self.scheme:
            return self.schemes[0]
        if self.scheme not in self.schemes:
            raise ModelError(f"scheme = {self.scheme!r}; {type(self).__name__} has {', '.join(map(repr, self.schemes))}")
        return self.scheme

    def _set(self, **fields: Any) -> None:
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    def _declare_symbols(self, state: str, **symbols: Any) -> Converter:
        """Declare t, the state and the other symbols, check the common arguments, return the converter."""
        given = {label: declare(value, label) for label, value in symbols.items() if value is not None}
        if state not in given or not given[state].names:
            raise ModelError(f"{state}: no state symbols are given; give for example {state}=ca.SX.sym('{state}', 2)")
        time = declare(ca.SX.sym("t") if self.t is None else self.t, "t")
        if len(time.names) != 1:
            raise ModelError(f"t: {len(time.names)} symbols given; expected one scalar time symbol")
        p, values, vectors = declare_parameters(self.parameters)
        driving = DeclaredInputs.of({} if self.inputs is None else self.inputs, self.blocks, self.unblocked, values)
        self._set(u=driving.u, input_groups=MappingProxyType(driving.groups))
        known = [*([] if self.t is None else [time]), *given.values(), *p, *driving.symbols]
        converter = Converter(known)
        own = given[state]
        names, stems = state_names_and_stems(self.names, own, state, self.has)
        self._set(
            t=time.sx,
            p=ca.vertcat(ca.SX(0, 1), *(item.sx for item in p)),
            parameters=MappingProxyType(values),
            vectors=MappingProxyType(vectors),
            names=tuple(names),
            stems=MappingProxyType(stems),
            units=MappingProxyType(read_units(self.units)),
            title="" if self.title is None else one_line(str(self.title)),
            **{label: item.sx for label, item in given.items()},
        )
        self._set(**check_grid_arguments(self.t_end, self.step, self.steps), switch_times=check_switch_times(self.switch_times))
        if self.exact is not None and not callable(self.exact):
            self._set(exact=self._read_vector(converter, self.exact, "exact", len(names), [time.sx]))
            if not self.p.numel():
                self._set(exact=SampledExactState(time.sx, self.exact))
        read = [time.sx, own.sx, *(given[name].sx for name in ("lam",) if name in given)]
        own_fields = driving.fields(
            time, self.p, converter, lambda expression, label: self._check_symbols(expression, label, read)
        )
        self._set(**own_fields)
        return converter

    def _read_vector(
        self, converter: Converter, value: Any, label: str, size: int, allow: Sequence[ca.SX], *, infinite: bool = False
    ) -> ca.SX:
        """A column of ``size`` expressions of the symbols in ``allow``; a scalar 0 stands for zeros."""
        column = ca.densify(ca.SX(converter.convert(value, label)))
        if column.shape[0] == 1 and column.shape[1] == size:
            column = column.T
        if column.numel() == 1 and size != 1 and column.is_zero():
            column = ca.SX.zeros(size)
        if column.shape != (size, 1):
            expected = "one scalar expression" if size == 1 else f"a column of {size} entries"
            raise ModelError(f"{label}: shape {column.shape}; expected {expected}")
        self._check_symbols(column, label, allow)
        if not infinite:
            check_finite(column, label)
        return column

    def _read_matrix(self, converter: Converter, value: Any, label: str, shape: tuple[int, int], why: str) -> ca.SX:
        """A matrix of numbers or expressions of the parameters, of the given shape, without zeros; vectors are laid along it."""
        matrix = ca.sparsify(ca.SX(converter.convert(value, label)))
        if matrix.shape != shape and matrix.shape == shape[::-1] and 1 in shape:
            matrix = matrix.T
        if matrix.shape != shape:
            hint = "; it seems to be transposed" if matrix.shape == shape[::-1] else ""
            raise ModelError(f"{label}: shape {matrix.shape}; expected {shape}, {why}{hint}")
        self._check_symbols(matrix, label, [])
        check_finite(matrix, label)
        return matrix

    def _read_start(self, converter: Converter, value: Any, label: str, size: int) -> ca.SX:
        """A start value: ``size`` finite numbers, or expressions of the parameters."""
        return self._read_vector(converter, value, label, size, [])

    def _check_symbols(self, expression: ca.SX, label: str, allow: Sequence[ca.SX]) -> None:
        allowed = {str(s) for group in [*allow, self.p] for s in ca.symvar(ca.SX(group))}
        allowed |= {str(s) for s in ca.symvar(self.u)} if str(self.t) in allowed else set()
        for symbol in ca.symvar(expression):
            if symbol.name() not in allowed:
                raise ModelError(
                    f"{label} depends on '{symbol.name()}', but may depend only on {', '.join(sorted(allowed)) or 'numbers'}; "
                    + self._where_to_put(symbol.name())
                )

    def _where_to_put(self, name: str) -> str:
        """What to do with a symbol that an argument may not depend on."""
        if name in {str(s) for s in ca.symvar(self.u)}:
            return f"{self.of_time}; FirstOrderSystem takes inputs anywhere"
        return self.of_time if name == str(self.t) else MOVE_TERM_HINT

    def _named_constraints(
        self, converter: Converter, constraints: Any, allow: Sequence[ca.SX]
    ) -> tuple[dict[str, ca.SX], list[str]]:
        """{name: column of expressions >= 0} and one name for each row."""
        constraints = {} if constraints is None else constraints
        if not isinstance(constraints, Mapping):
            raise ModelError(f"constraints: expected a dictionary {{name: expression >= 0}}, not a {type(constraints).__name__}")
        columns, names = {}, []
        for name, value in constraints.items():
            label = f"constraint '{name}'"
            column = ca.densify(ca.vec(ca.SX(converter.convert(value, label))))
            for row in ca.vertsplit(column):
                if row.op() in TRUTH_VALUED_OPERATIONS:
                    raise ModelError(f"{label}: {row} is a comparison; give the expression that stays >= 0, such as q[0] - 1")
            self._check_symbols(column, label, allow)
            columns[str(name)] = column
            names += numbered_row_names(str(name), column.numel())
        return columns, names

    @property
    def weights(self) -> tuple[float, float] | None:
        """theta and gamma, where the scheme of the class has them."""
        return None

    @property
    def state(self) -> ca.SX:
        """The symbols of the state, under the letter of the class."""
        return getattr(self, self.letter)

    @property
    def start(self) -> Any:
        """The state at t = 0, under the letter of the class."""
        return getattr(self, f"{self.letter}0")

    def check_allowed(self, what: str) -> None:
        """Raise UsageError where the class refuses to be used for it, or the model's inputs have no place there."""
        if self.u.numel() and what in INPUT_FREE_USES:
            of = f"'{self.title or type(self).__name__}' has inputs ({', '.join(self.input_groups)})"
            raise UsageError(f"{what}: {of}; certificates do not cover signals")
        if why := self.refuses.get(what):
            raise UsageError(f"{what}: '{self.title or type(self).__name__}' {why}")

    @property
    def row_names(self) -> tuple[str, ...]:
        """Names of what besides states may have a unit: of the multipliers, where a class does not say more."""
        return getattr(self, "multiplier_names", ())

    @property
    def tied_to_step(self) -> bool:
        """Whether the start is that of one step alone, as two positions are."""
        return False

    @property
    def axes(self) -> tuple[tuple[str, ...], Mapping[str, Sequence[int]]]:
        """Names and stems of the coordinates in which a box of states is given."""
        return tuple(self.names), self.stems

    def points(self, rows: np.ndarray) -> np.ndarray:
        """Rows of states (k, n) as points in the coordinates of ``axes``."""
        return rows

    @property
    def parameter_names(self) -> list[str]:
        """The names that ``bind`` knows: of vectors and matrices, and of all scalars."""
        return [*self.vectors, *self.parameters]

    def values_of(self, parameters: Values | None) -> dict[str, float | None]:
        """Return {name: value} of each scalar in ``parameters``, where names and symbols may stand for vectors and matrices.

        Raises:
            UsageError: a name that is not declared or comes twice, values of another shape than declared.
        """
        return scalar_values(parameters, self.parameters, self.vectors)

    @property
    def input_names(self) -> tuple[str, ...]:
        """One name for each scalar input."""
        return tuple(name for names in self.input_groups.values() for name in names)

    @property
    def values_taken(self) -> list[int | None]:
        """Of each input how many values it takes at most; None: any."""
        return [
            None if signal is None else signal.values_taken
            for name, signal in self.inputs.items()
            for _ in self.input_groups[name]
        ]

    def bind(self, values: Values | None = None, *, partly: bool = False) -> Self:
        """Return the model with its parameters replaced by numbers: ``values`` first, then those declared.

        With ``partly``, parameters without a value stay symbols.

        Raises:
            UsageError: see `values_of`; a parameter without a value.
        """
        values = self.values_of(values)
        numbers = {**self.parameters, **values}
        missing = [name for name, value in numbers.items() if value is None]
        if missing and not partly:
            name = missing[0]
            raise UsageError(f"parameter '{name}' has no value; give it with --set {name}=VALUE or parameters={{...}}")
        checked = {name: value for name, value in numbers.items() if value is not None}
        if not checked:
            return self
        given = [i for i, value in enumerate(numbers.values()) if value is not None]
        bound = substitute_in_model(self, self.p[given], ca.SX(list(checked.values())))
        rest = ca.vertcat(ca.SX(0, 1), *(self.p[i] for i in range(self.p.numel()) if i not in given))
        whole = {name: names for name, names in self.vectors.items() if set(names.ravel()) <= set(missing)}
        bound._set(p=rest, parameters=MappingProxyType(dict.fromkeys(missing)), vectors=MappingProxyType(whole))
        bound._set(bound_parameters=MappingProxyType({**self.bound_parameters, **checked}))
        text = ", ".join(f"{name} = {value:g}" for name, value in checked.items())
        bound._check_defined(text)
        for name, expression in named_expressions(self):
            check_defined(expression, self.p[given], ca.DM(list(checked.values())), f"with {text}, {name}")
        if isinstance(bound.exact, ca.SX) and not missing:
            bound._set(exact=SampledExactState(bound.t, bound.exact))
        return bound

    def _check_units(self) -> None:
        """Refuse the unit of something that the model does not have."""
        rows, states = self.row_names, list(self.names)
        known = ["t", *self.stems, *states, *rows, *(row.partition("[")[0] for row in rows), *self.parameter_names]
        known += [*self.input_groups, *self.input_names, *self.outputs]
        bounds = [f"{end} {name}" for end in ("lower", "upper") for name in states]
        for name in self.units:
            group = name.partition("[")[0]
            if not (
                {name, group} & {*known, *bounds, *self.has, *ARRAYS_WITH_UNITS, *RESERVED_RUN_NAMES}
                or group.startswith(KINK_PREFIXES)
            ):
                raise ModelError(
                    f"units: '{name}' is not a state, multiplier or time; the model has {', '.join(dict.fromkeys(known))}"
                    + did_you_mean(name, known)
                )

    def _check_defined(self, given: str) -> None:
        """Refuse entries that the parameters made infinite or NaN; bounds and the ends of a law may be infinite."""
        for name, value in vars(self).items():
            if isinstance(value, ca.SX) and name not in ("lower", "upper"):
                check_finite(value, f"with {given}, {name}", UsageError)
