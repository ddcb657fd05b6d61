"""Adapters that recognise a training script by the names in its source."""

from __future__ import annotations

from collections.abc import Container
from typing import Any, ClassVar

from skipgs_plug.adapters import registry
from skipgs_plug.adapters.base import AbstractAdapter
from skipgs_plug.adapters.loop_code import LOOP, LoopCode, namespace_of
from skipgs_plug.core.caution import caution
from skipgs_plug.core.errors import AdapterMismatchError


class MarkedScript(AbstractAdapter):
    """Base of adapters for scripts with a function `training` and a `GaussianModel`, which differ by their names.

    Attributes:
        mark: A name that only this fork's training scripts have, or only their loop uses.
        needs: Further names that they have, such as its renderer and options. Another fork may have the mark by chance.
    """

    mark: ClassVar[str] = ""
    needs: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def matches(cls, trainer: Any) -> bool:
        names = namespace_of(trainer)
        return (
            names is not None
            and {LOOP, "GaussianModel"} <= names.keys()
            and cls.recognises_script(LoopCode.of_module(names))
        )

    @classmethod
    def recognises_script(cls, code: LoopCode) -> bool:
        return bool(code.used) and "GaussianModel" in code.names and cls.recognises(code.names)

    @classmethod
    def recognises(cls, names: Container[str]) -> bool:
        """Whether a training script with these names belongs to this trainer. Adapters before it in the registry win.

        Args:
            names: Its global names, and all names and attributes that its function `training` uses.
        """
        return all(name in names for name in (cls.mark, *cls.needs))

    def require_own(self, code: LoopCode, begun: bool = False) -> None:
        """Refuse a script that looks like another trainer's; warn if it may be either's, since the user chose this one.

        Args:
            code: The training script.
            begun: Whether training begins, so that the user has been warned.

        Raises:
            AdapterMismatchError: It looks like another trainer's, and not like this one's.
        """
        own, family = type(self), [one for one in registry.builtin_adapters() if issubclass(one, MarkedScript)]
        asked = family if own in family else [own, *family]
        right = next(one for one in asked if one.recognises(code.names))  # the last, `inria`, recognises every script
        if right is own:
            return
        found = f"{code.source} looks like the training script of {right.name!r}"
        if not own.recognises(code.names):
            raise AdapterMismatchError(f"Adapter {self.name!r} is for {self.checked}, but {found}.")
        if not begun:
            caution(f"{found}, whose adapter knows more about it than {self.name!r}, which you named.")
