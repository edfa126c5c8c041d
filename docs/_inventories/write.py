"""Write the inventories of other projects: of each the few objects that signatures refer to, and where they are described."""

from pathlib import Path

from sphobjinv import DataObjStr, Inventory, compress, writebytes

HERE = Path(__file__).parent
LIBRARY = {
    "collections.abc.Callable": "collections.abc", "collections.abc.Iterable": "collections.abc",
    "collections.abc.Iterator": "collections.abc", "collections.abc.Mapping": "collections.abc",
    "collections.abc.Sequence": "collections.abc", "fractions.Fraction": "fractions", "pathlib.Path": "pathlib",
}  # fmt: skip
BUILT_IN = ("bool", "bytes", "dict", "float", "int", "list", "object", "set", "slice", "str", "tuple", "type")
ERRORS = ("AttributeError", "Exception", "KeyError", "KeyboardInterrupt", "ValueError", "RuntimeError")
PROJECTS = {
    "python": {
        **{name: ("class", f"library/{page}.html#{name}") for name, page in LIBRARY.items()},
        **{name: ("class", f"library/functions.html#{name}") for name in BUILT_IN},
        **{name: ("exception", f"library/exceptions.html#{name}") for name in ERRORS},
        "typing.Any": ("data", "library/typing.html#typing.Any"),
        "None": ("data", "library/constants.html#None"),
    },
    "numpy": {
        "numpy.ndarray": ("class", "reference/generated/numpy.ndarray.html#numpy.ndarray"),
        "numpy.random.Generator": ("class", "reference/random/generator.html#numpy.random.Generator"),
    },
    "matplotlib": {
        "matplotlib.axes.Axes": ("class", "api/_as_gen/matplotlib.axes.Axes.html#matplotlib.axes.Axes"),
        "matplotlib.figure.Figure": ("class", "api/_as_gen/matplotlib.figure.Figure.html#matplotlib.figure.Figure"),
    },
    "xarray": {"xarray.Dataset": ("class", "generated/xarray.Dataset.html#xarray.Dataset")},
    "pandas": {"pandas.DataFrame": ("class", "reference/api/pandas.DataFrame.html#pandas.DataFrame")},
}

for project, objects in PROJECTS.items():
    inventory = Inventory()
    inventory.project, inventory.version = project, ""
    for name, (role, uri) in sorted(objects.items()):
        inventory.objects.append(DataObjStr(name=name, domain="py", role=role, priority="1", uri=uri, dispname="-"))
    writebytes(str(HERE / f"{project}.inv"), compress(inventory.data_file(contract=True)))
