"""How a block and its accelerated twin belong together: the twin knows its plain class, and a tree of modules can be made plain."""

from typing import TypeVar

from torch import nn

from ..normals import NormalFromIntensity as PlainNormalFromIntensity

_Module = TypeVar("_Module", bound=nn.Module)


class Twin(nn.Module):
    """Mix-in of accelerated blocks; ``plain`` is the class that TorchScript gets in their place."""

    plain: type[nn.Module]

    def __prepare_scriptable__(self) -> nn.Module:
        return scriptable(self)


def reference(module: _Module, memo: dict[int, nn.Module] | None = None) -> _Module:
    """The same module of plain blocks: a tree of its own that shares all parameters, buffers and settings.

    Args:
        module: any module; parts that are no twins are copied as they are.
        memo: modules already made plain, by identity.
    Example:
        >>> from torchvts import PoissonDCT
        >>> type(reference(PoissonDCT(0.1))).__module__
        'torchvts.integration.poisson'
    """
    memo = {} if memo is None else memo
    if id(module) not in memo:
        if isinstance(module, PlainNormalFromIntensity):
            module.follow_lights()  # a copy may be a graph's, in which what is stored of the lights stands
        kind = module.plain if isinstance(module, Twin) else type(module)
        copy = kind.__new__(kind)
        copy.__dict__.update(module.__dict__)
        memo[id(module)] = copy
        copy.__dict__["_modules"] = {
            name: None if child is None else reference(child, memo) for name, child in module._modules.items()
        }
    return memo[id(module)]  # type: ignore[return-value]


def scriptable(module: _Module) -> _Module:
    """:func:`reference` for ``__prepare_scriptable__``.

    ``torch.jit.script`` remembers modules by their identity and puts the copy in the module's place, so the copy keeps the module
    alive: another object could be created with its identity.
    """
    copy = reference(module)
    copy.__dict__["_module_of_this_copy"] = (module,)
    return copy
