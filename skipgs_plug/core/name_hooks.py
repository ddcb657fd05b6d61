"""Names in the code of a trainer that an adapter replaces, and puts back when the gate is detached or released."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from skipgs_plug.core.intercept import Around, Patches


class NameHooks:
    """The part of `Hooks` about replaced names.

    Args:
        patches: List of replacements in the trainer.
    """

    def __init__(self, patches: Patches) -> None:
        self._patches = patches

    def wrap(self, owner: Any, name: str, around: Around) -> None:
        """Call `around(original, *args, **kwargs)` in place of each `owner.name(*args, **kwargs)`.

        Args:
            owner: A class (`args` then begin with the instance), an instance, a module, or the namespace dict of a
                module.
            name: Attribute to replace.
            around: The replacement.

        Raises:
            AdapterMismatchError: The owner has no function of this name.
            SkipGSError: A gate has replaced the name already.
        """
        self._patches.wrap(owner, name, around)

    def before(self, owner: Any, name: str, call: Callable[..., Any]) -> None:
        """Call `call(*args, **kwargs)` before each `owner.name(*args, **kwargs)`.

        Args:
            owner: The object that holds the function; see `wrap`, also for errors.
            name: Attribute of the function.
            call: The function to call first.
        """

        def around(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            call(*args, **kwargs)
            return original(*args, **kwargs)

        self.wrap(owner, name, around)

    def on_detach(self, label: str, undo: Callable[[], None]) -> None:
        """Undo another change too when the gate is detached or released.

        Args:
            label: Name of what was changed, for `SkipGate.patched`.
            undo: Undoes the change.
        """
        self._patches.add_undo(label, undo)

    @property
    def patched(self) -> list[str]:
        """Every name that is replaced at present."""
        return self._patches.names

    def restore(self) -> None:
        """Restore every replaced name."""
        self._patches.restore()
