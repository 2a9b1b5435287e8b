"""lazy_exports: imports the public names of a package when they are first used.

So the import of one name does not import the dependencies of others (vtk, scipy), and --help is immediate. The names
are declared once, in the imports under `if TYPE_CHECKING`, which editors and type checkers read too. No name may be
that of a module in the package, since importing the module would replace it.
"""

from __future__ import annotations

import importlib
from functools import cache
from types import CodeType


def lazy_exports(namespace: dict) -> None:
    """Add to a package's `namespace` (its globals()) the names that its code imports under `if TYPE_CHECKING`."""
    package = namespace["__name__"]
    needed = frozenset(namespace)

    @cache
    def homes() -> dict[str, str]:
        declared = _imports(namespace["__spec__"].loader.get_code(package))
        # Names that the package itself needs, imported immediately.
        return {name: f"{package}.{module}" for name, module in declared.items() if name not in needed}

    def getattr_(name: str):
        if name == "__all__":
            return sorted(homes())
        if name.startswith("__") or name not in homes():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = namespace[name] = getattr(importlib.import_module(homes()[name]), name)
        return value

    namespace.update(__getattr__=getattr_, __dir__=lambda: sorted(homes()))


def _imports(code: CodeType) -> dict[str, str]:
    """{name: module} of all `from module import name` in the code of a module, whether they are executed or not.

    Read from the byte code, since a build may omit the source.
    """
    import dis  # imported here, since it takes longer than the rest of this package

    found, module = {}, ""
    for instruction in dis.get_instructions(code):
        if instruction.opname == "IMPORT_NAME":
            module = instruction.argval
        elif instruction.opname == "IMPORT_FROM":
            found[instruction.argval] = module
    return found
