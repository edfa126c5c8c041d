"""A sweep as other programs read it: npz, a table of its cells, xarray and what that writes."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.archive import write_npz
from nsmodel.errors import MissingExtraError, StorageError
from nsmodel.extras import import_extra
from nsmodel.storage import dumps, replace_atomically
from nsmodel.sweep.asked import CELL_BACKENDS
from nsmodel.sweep.variable import STATUS_NAMES

if TYPE_CHECKING:
    from nsmodel.sweep.result import Sweep


def design_arrays(sweep: Sweep) -> dict[str, np.ndarray]:
    """What varies, and the times of the rows, as files have them; texts are in the ``header``."""
    dims = {f"dim:{dim}": sweep.coords[dim] for dim in sweep.dims if sweep.coords[dim].dtype.kind != "U"}
    return dims | {f"value:{name}": values for name, (values, _) in sweep.varied.items()} | {"t": sweep.t}


def sweep_metadata(sweep: Sweep) -> dict[str, Any]:
    """The metadata of its file."""
    along = {name: list(axes) for name, (_, axes) in sweep.varied.items()}
    labels = {dim: sweep.coords[dim].tolist() for dim in sweep.dims if sweep.coords[dim].dtype.kind == "U"}
    texts = {"labels": labels} if labels else {}
    return {**sweep.metadata, "dims": list(sweep.dims), "along": along, "shape": list(sweep.shape), **texts}


def write_sweep(sweep: Sweep, path: Path) -> None:
    """One npz file."""
    messages = {str(cell): sweep.messages[cell] for cell in sorted(sweep.messages)}
    write_npz(path, {**design_arrays(sweep), **sweep.cells}, {**sweep_metadata(sweep), "messages": messages})


def cell_table(sweep: Sweep) -> dict[str, np.ndarray]:
    """One row a cell: its number, what varies, outputs, facts, status in words and message."""
    places = np.unravel_index(np.arange(sweep.size), sweep.shape) if sweep.dims else ()
    found: dict[str, np.ndarray] = {"cell": np.arange(sweep.size)}
    found |= {dim: np.asarray(sweep.coords[dim])[place] for dim, place in zip(sweep.dims, places, strict=True)}
    for name, (values, axes) in sweep.varied.items():
        own = values[tuple(places[axis] for axis in axes)].reshape(sweep.size, -1)
        found |= {name if own.shape[1] == 1 else f"{name}_{i}": column for i, column in enumerate(own.T)}
    for name in [name for name in sweep.cells if name not in sweep.metadata.get("keep", ())]:
        values = sweep.cells[name].reshape(sweep.size, -1)
        if name != "status":
            found |= {name if values.shape[1] == 1 else f"{name}_{i}": column for i, column in enumerate(values.T)}
    found["way"] = np.array([CELL_BACKENDS[way] if way >= 0 else "" for way in sweep.cells["way"].tolist()])
    found["status"] = np.array([STATUS_NAMES[code] for code in sweep.cells["status"].tolist()])
    found["message"] = np.array([sweep.messages.get(cell, "") for cell in range(sweep.size)])
    return found


def sweep_dataset(sweep: Sweep) -> Any:
    """An ``xarray.Dataset``: quantities along the sweep's dimensions and their own, what varies as coordinates."""
    xarray = import_extra("xarray")
    units = {name: {"units": unit} for name, unit in sweep.units.items()}
    data = {}
    for name in sweep.cells:
        if name != "status":
            variable = sweep[name]
            data[name] = (variable.dims, variable.values, units.get(name))
    coords: dict[str, Any] = {dim: (dim, np.asarray(sweep.coords[dim]), units.get(dim)) for dim in sweep.dims}
    coords["status"] = (sweep.dims, sweep.status)
    if sweep.metadata.get("keep"):
        coords["t"] = ("t", sweep.t, units.get("t"))
    for name, (values, axes) in sweep.varied.items():
        if name not in coords and values.ndim == len(axes):
            coords[name] = (tuple(sweep.dims[axis] for axis in axes), values, units.get(name))
    data["message"] = (sweep.dims, np.array([sweep.messages.get(cell, "") for cell in range(sweep.size)]).reshape(sweep.shape))
    plain = {key: value if type(value) in (str, int, float) else dumps(value) for key, value in sweep.metadata.items()}
    found = xarray.Dataset(data, coords, plain)
    if sweep.metadata.get("low_discrepancy"):
        for name in data:
            found[name].attrs["low_discrepancy"] = 1
    return found


def write_netcdf(sweep: Sweep, path: Path) -> None:
    """A netCDF file."""
    found = sweep_dataset(sweep)
    if not any(map(_is_installed, ("netCDF4", "h5netcdf"))):
        raise MissingExtraError("netCDF files need netCDF4 or h5netcdf; pip install netCDF4, or keep the npz file")
    with replace_atomically(path) as part:
        found.to_netcdf(part)


def write_zarr(sweep: Sweep, path: Path) -> None:
    """A zarr store."""
    import_extra("zarr")
    try:
        sweep_dataset(sweep).to_zarr(path, mode="w", zarr_format=2)
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error}; take a folder that is writable and has room") from error


def _is_installed(package: str) -> bool:
    try:
        import_module(package)
    except ImportError:
        return False
    return True


def sweep_frame(sweep: Sweep) -> Any:
    """`table` as a ``pandas.DataFrame`` by cell; MissingExtraError where pandas is not installed."""
    found = import_extra("pandas").DataFrame(cell_table(sweep)).set_index("cell")
    found.attrs = {"title": sweep.title, "units": {name: unit for name, unit in sweep.units.items() if name in found}}
    return found
