"""What must hold of an ITK transform: ITK takes fewer numbers than a kind needs, and reads beyond their end.

A number that it cannot read, such as `inf`, ends a list without a word. With what is left an Euler transform is made of
whatever lies behind, or the process ends; without a line of parameters it is the identity. Source: ITK's
itkTxtTransformIO.hxx, SetParameters of itkEuler3DTransform.hxx.
"""

from __future__ import annotations

import re
from pathlib import Path

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.files import read_small

#: Parameters of the linear kinds in three dimensions
_LINEAR = {
    "IdentityTransform": 0,
    "TranslationTransform": 3,
    "ScaleTransform": 3,
    "ScaleLogarithmicTransform": 3,
    "VersorTransform": 3,
    "Euler3DTransform": 6,
    "VersorRigid3DTransform": 6,
    "Similarity3DTransform": 7,
    "QuaternionRigidTransform": 7,
    "ScaleVersor3DTransform": 9,
    "AffineTransform": 12,
    "MatrixOffsetTransformBase": 12,
    "ComposeScaleSkewVersor3DTransform": 12,
    "ScaleSkewVersor3DTransform": 15,
}
_COMPOSITE = "CompositeTransform"
_NUMBER = r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]{1,3})?"


def require_sound_text(path: Path) -> None:
    """Raise SimulationError unless a text file holds one linear transform, or a chain of them, with all its numbers."""
    content = read_small(path)
    require(_is_text(content), f"{path}: is not a text, expected an ITK transform")
    fields = [
        (name.strip(), value.strip())
        for name, colon, value in (line.partition(":") for line in content.decode("utf-8").split("\n"))
        if colon and not name.lstrip().startswith("#")
    ]
    kinds = [value for name, value in fields if name == "Transform"]
    require(bool(kinds), f"{path}: has no line Transform, expected an ITK transform")
    is_chain = kinds[0].startswith(_COMPOSITE)
    require(
        is_chain or len(kinds) == 1, f"{path}: has {len(kinds)} transforms that are not chained, expected one transform"
    )
    expected = []
    for kind in kinds:
        name = _known(path, kind)
        expected.append(("Transform", kind))
        if name != _COMPOSITE:
            expected += [("Parameters", name), ("FixedParameters", name)]
    require(
        [name for name, _ in fields] == [name for name, _ in expected],
        f"{path}: has the lines {', '.join(name[:20] for name, _ in fields[:9])}, expected Transform, Parameters and "
        "FixedParameters of each",
    )
    for (field, text), (_, kind) in zip(fields, expected, strict=True):
        if field == "Transform":
            continue
        numbers = text.split()
        wrong = next((part for part in numbers if not re.fullmatch(_NUMBER, part) or abs(float(part)) > 1e300), None)
        require(wrong is None, f"{path}: {field} of {kind} has {wrong!r:.40}, expected numbers")
        require(field != "Parameters" or len(numbers) == _LINEAR[kind], _counted(path, kind, len(numbers)))


def require_sound(path: Path, transform) -> None:
    """Raise SimulationError unless a SimpleITK transform is linear and has all its numbers."""
    import SimpleITK as sitk

    require(transform.IsLinear(), f"{path}: the transform is not linear, expected a rigid one")
    if transform.GetName() == _COMPOSITE:
        chain = sitk.CompositeTransform(transform)
        for n in range(chain.GetNumberOfTransforms()):
            require_sound(path, chain.GetNthTransform(n))
        return
    kind, found = transform.GetName(), len(transform.GetParameters())
    require(kind in _LINEAR, f"{path}: {kind} is not read, expected one of {', '.join(_LINEAR)}")
    require(found == _LINEAR[kind], _counted(path, kind, found))


def _known(path: Path, kind: str) -> str:
    """The name of a kind that is read, as of "Euler3DTransform_double_3_3"."""
    name, _, rest = kind.partition("_")
    is_known = re.fullmatch(r"(double|float)_3_3", rest) is not None and (name in _LINEAR or name == _COMPOSITE)
    require(
        is_known,
        f"{path}: the transform is {kind!r:.60}, expected a linear one in three dimensions: {', '.join(_LINEAR)}",
    )
    return name


def _counted(path: Path, kind: str, found: int) -> str:
    return f"{path}: {kind} has {found} parameters, expected {_LINEAR[kind]}"


def _is_text(content: bytes) -> bool:
    try:
        return "\0" not in content.decode("utf-8")
    except UnicodeDecodeError:
        return False
