"""A model in short: what it has, by name, with units; the ``repr`` of models."""

from __future__ import annotations

from typing import Any

from nsmodel._utils import TEXT_WIDTH, format_number, join_within_width, truncate_text

LABEL_COLUMNS = 14  # Columns of a label in a description: two before it, the 11 letters of the longest, and one.


def model_facts(model: Any) -> dict[str, list[str]]:
    """{what: the entries}, each with its unit or value; those left out that the model does not have."""
    inputs = [f"{name}: {_describe_signal(signal)}" for name, signal in model.inputs.items() if not _is_set_by_block(signal)]
    rows = getattr(model, "multiplier_names", ())
    found = {
        "states": [_name_with_unit(model, name) for name in model.names],
        "multipliers": [_name_with_unit(model, name) for name in rows],
        "constraints": [] if rows else list(map(str, getattr(model, "constraints", None) or ())),
        "parameters": _parameter_entries(model),
        "inputs": inputs,
        "blocks": [f"{block.name}, {_tick_times_text(block)}" for block in model.blocks],
        "outputs": [_name_with_unit(model, name) for name in model.outputs],
    }
    if law_text := getattr(getattr(model, "law", None), "description", ""):
        found["law"] = [law_text]
    found["time"] = [", ".join(_time_entries(model))]
    return {label: entries for label, entries in found.items() if entries}


def describe_model(self: Any) -> str:
    """Return the class, the title and a line for each of its `facts`, of 100 columns."""
    lines = [truncate_text(f"{type(self).__name__}: {self.title or 'untitled'}", TEXT_WIDTH)]
    for label, entries in model_facts(self).items():
        head = f"  {label:{LABEL_COLUMNS - 2}}" + (f"{len(entries)}: " if len(entries) > 1 else "")
        lines.append(head + join_within_width([truncate_text(entry) for entry in entries], TEXT_WIDTH - len(head)))
    return "\n".join(lines)


def unit_of(model: Any, name: str) -> str:
    """The unit of a name, or that of the symbol or group which it belongs to; "" where there is none."""
    units = model.units
    if name in units:
        return units[name]
    groups = {stem: [model.names[i] for i in at] for stem, at in model.stems.items() if stem in units}
    groups |= {stem: list(names.ravel()) for stem, names in model.vectors.items() if stem in units}
    stem = next((stem for stem, names in groups.items() if name in names), name.partition("[")[0])
    return units.get(stem, "")


def _name_with_unit(model: Any, name: str) -> str:
    unit = unit_of(model, name)
    return f"{name} [{unit}]" if unit else str(name)


def _parameter_entries(model: Any) -> list[str]:
    values = {**model.parameters, **model.bound_parameters}
    found = []
    for name, value in values.items():
        text = "no value" if value is None else format_number(value)
        found.append(f"{name} = {text} {unit_of(model, name)}".rstrip())
    return found


def _is_set_by_block(signal: Any) -> bool:
    """Whether a block sets it."""
    return getattr(signal, "by", None) is not None


def _describe_signal(signal: Any) -> str:
    return "given when it is run" if signal is None else repr(signal)


def _tick_times_text(block: Any) -> str:
    return "after each step" if block.period is None else f"every {format_number(block.period)}"


def _time_entries(model: Any) -> list[str]:
    unit = f" {model.units['t']}" if "t" in model.units else ""
    parts = [] if model.t_end is None else [f"0 to {format_number(model.t_end)}{unit}"]
    if model.step is not None:
        parts.append(f"step {format_number(model.step)}{unit}")
    elif model.steps is not None:
        parts.append(f"{len(model.steps)} given steps")
    return [*parts, f"scheme {model.scheme}"]
