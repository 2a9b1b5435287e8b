"""lazy_exports: the face of a package, whose public names are imported when they are first used.

So an import of one name does not pay for the others (vtk, scipy), and the command answers --help at once. A face
declares its names once, in the imports under `if TYPE_CHECKING`, which editors and type checkers read too. No name may
be that of a module in the package: importing the module would put it in the name's place.
"""

from __future__ import annotations

import importlib
from functools import cache


def lazy_exports(namespace: dict) -> None:
    """Give a package's `namespace` (its globals()) the names that its source imports under `if TYPE_CHECKING`."""
    package = namespace["__name__"]

    @cache
    def homes() -> dict[str, str]:
        return _declared(package, namespace["__spec__"].loader.get_source(package))

    def getattr_(name: str):
        if name == "__all__":
            return sorted(homes())
        if name.startswith("__") or name not in homes():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = namespace[name] = getattr(importlib.import_module(homes()[name]), name)
        return value

    namespace.update(__getattr__=getattr_, __dir__=lambda: sorted(homes()))


def _declared(package: str, source: str) -> dict[str, str]:
    """{public name: module that defines it} of a face."""
    import ast  # not before it is needed: it takes longer to import than the rest of this package

    blocks = [
        node.body
        for node in ast.parse(source).body
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
    ]
    return {
        alias.name: f"{package}.{entry.module}"
        for block in blocks
        for entry in block
        if isinstance(entry, ast.ImportFrom)
        for alias in entry.names
    }
