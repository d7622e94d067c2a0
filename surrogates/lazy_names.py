"""A package's public names: each is imported from its module when it is first used.

The stub beside the package says which and from where, as editors and type checkers read it.
"""

import sys
from importlib import import_module
from types import ModuleType


class _Package(ModuleType):
    """Keeps a public function where a module of its name is imported, as a command's is."""

    _modules: dict[str, tuple[str, str]]

    def __getattr__(self, name: str) -> object:
        if name not in self._modules:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        module, own = self._modules[name]
        value = getattr(import_module(module), own)
        setattr(self, name, value)
        return value

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in self._modules and isinstance(value, ModuleType)):
            super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return sorted(vars(self)["__all__"])


def from_stub(package: str) -> list[str]:
    """Give a package that is being imported the names of its stub.

    Parameters
    ----------
    package : str
        Its name, in `sys.modules`.

    Returns
    -------
    list of str
        The names, sorted.
    """
    module = sys.modules[package]
    with open(f"{str(module.__file__).removesuffix('.py')}.pyi", encoding="utf-8") as stub:
        lines = [line.split() for line in stub if line.startswith("from ")]
    # `from MODULE import OWN as NAME`
    vars(module)["_modules"] = {words[5]: (words[1], words[3]) for words in lines}
    module.__class__ = _Package
    return sorted(vars(module)["_modules"])
