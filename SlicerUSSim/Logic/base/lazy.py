"""lazy_exports: the face of a package, whose public names are imported when they are first used.

So an import of one name does not pay for the others (vtk, scipy), and the command answers --help at once. A face
declares its names once, in the imports under `if TYPE_CHECKING`, which editors and type checkers read too. No name may
be that of a module in the package: importing the module would put it in the name's place.
"""

from __future__ import annotations

import importlib
from functools import cache
from types import CodeType


def lazy_exports(namespace: dict) -> None:
    """Give a package's `namespace` (its globals()) the names that its code imports under `if TYPE_CHECKING`."""
    package = namespace["__name__"]
    needed = frozenset(namespace)

    @cache
    def homes() -> dict[str, str]:
        declared = _imports(namespace["__spec__"].loader.get_code(package))
        # What the face itself needs, which is imported at once.
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

    Read from the code and not from its text, which a build may leave out.
    """
    import dis  # not before it is needed: it takes longer to import than the rest of this package

    found, module = {}, ""
    for instruction in dis.get_instructions(code):
        if instruction.opname == "IMPORT_NAME":
            module = instruction.argval
        elif instruction.opname == "IMPORT_FROM":
            found[instruction.argval] = module
    return found
