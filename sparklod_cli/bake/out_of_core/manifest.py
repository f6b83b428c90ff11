"""The scratch folder of a bake: whose it is, whether a run is at work in it, and what becomes of it at the end."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...support.addresses import Place
from ...support.errors import FormatError, InvalidSplatsError, ScratchError, UnreadableError
from ...support.parallel import ordered_map
from ...support.stdin import DASH
from ...support.units import count_of
from ..recipe import Recipe
from .contracts import Store
from .lock import LOCK, locked
from .store import FileStore

#: How the names of scratch folders end.
SUFFIX = ".sparklod-scratch"

#: Bytes of an output's name up to which that of its scratch folder has it.
NAME_BYTES = 200

#: The name of the result that has the recipe.
RECIPE = "recipe"

#: Version of what results have and are called; one that differs cannot be gone on with.
LAYOUT = 1

#: Errors that another run of the same recipe would meet again.
HOPELESS = (FormatError, InvalidSplatsError)

#: Removes the marks of tasks that must be done again, as results that they made are lost.
Forget = Callable[[Store, list[str]], None]


def scratch_folder(target: Place, recipe: Callable[[], Recipe], parent: Place | None) -> Place:
    """The scratch folder of a bake: beside its output, or in a folder for those of several bakes.

    Args:
        target: the output. That of standard output (-) is among the system's temporary files.
        recipe: makes that of the output, where it is needed.
        parent: the folder for several; None for that of the output.
    """
    if target == DASH:
        return (parent or Path(tempfile.gettempdir())) / f"standard-output-{recipe().digest[:8]}{SUFFIX}"
    if parent is None:
        return target.parent / f"{_shortened(target.name)}{SUFFIX}"
    name = os.path.realpath(target) if isinstance(target, Path) else target.url
    return parent / f"{_shortened(target.name)}-{_digest(name)}{SUFFIX}"


def _shortened(name: str) -> str:
    """A name to which more can be added: file systems allow 255 bytes."""
    return name if len(os.fsencode(name)) <= NAME_BYTES else f"output-{_digest(name)}"


def _digest(text: str) -> str:
    return hashlib.blake2b(os.fsencode(text), digest_size=4).hexdigest()


@dataclass(frozen=True)
class _Manifest:
    """Whose results a store has.

    Attributes:
        recipe: of the output.
        block_splats: of the blocks that the scene was cut into.
    """

    recipe: Recipe
    block_splats: int

    def put(self, store: Store) -> None:
        """Writes it as a result."""
        text = np.frombuffer(self.recipe.to_json(), np.uint8)
        store.put(RECIPE, {"recipe": text, "numbers": np.array([LAYOUT, self.block_splats], np.int64)})

    @classmethod
    def get(cls, store: Store) -> _Manifest | None:
        """The one of a store; None where it has none that this version understands."""
        try:
            if not store.is_sound(RECIPE):
                return None
            found = store.get(RECIPE)
            layout, block_splats = found["numbers"].tolist()
            return cls(Recipe.from_json(found["recipe"].tobytes()), block_splats) if layout == LAYOUT else None
        except (KeyError, ValueError):
            return None


@contextlib.contextmanager
def at_work(
    store: Store,
    recipe: Recipe,
    block_splats: int,
    *,
    resume: bool,
    overwrite: bool,
    forget: Forget,
    say: Callable[[str], None],
) -> Iterator[int]:
    """A context in which a bake puts its results into a store, which is empty at the end if all went well.

    After an error that another run need not meet, or an interrupt, the results stay.

    Args:
        store: of the results.
        recipe: of the output.
        block_splats: of the blocks that the scene is cut into, unless that was done before.
        resume: go on with the results that are there.
        overwrite: remove them, unless `resume` is set.
        forget: called with the names of results that are damaged, after they were removed.
        say: told what was found, and what is left.

    Yields:
        the splats of a block: those of the run that began.

    Raises:
        ScratchError: a run is at work there; there are results and neither `resume` nor `overwrite` is set, or they are
            of another recipe; or the store cannot be written.
    """
    folder = _folder_of(store)
    with contextlib.nullcontext() if folder is None else locked(folder):  # an address cannot be locked
        former = _Manifest.get(store)
        names = [name for name in store.names() if name != RECIPE]
        if names and not resume and not overwrite:
            raise ScratchError(
                f"an interrupted bake left {store}; go on with it by --resume, or begin anew with --overwrite"
            )
        if names and resume:
            block_splats = _resumed(store, recipe, former, names, forget, say)
        else:
            _clear(store)
            _Manifest(recipe, block_splats).put(store)
        try:
            yield block_splats
        except BaseException as error:
            if _is_hopeless(error) or store.names() in ([], [RECIPE]):
                _clear(store)
            elif not isinstance(error, ScratchError):
                say(f"what is done stays in {store}; run it again with --resume to go on")
            raise
        _clear(store)


def _clear(store: Store) -> None:
    """Removes all that is there but the lock; last the files that tell what it is, for a run that is killed here."""
    folder = _folder_of(store)
    if folder is not None:
        for path in sorted(folder.iterdir(), key=lambda path: (path.is_file(), path.name)):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            elif path.name != LOCK:
                path.unlink(missing_ok=True)
    for name in store.names():
        store.remove(name)


def _resumed(
    store: Store,
    recipe: Recipe,
    former: _Manifest | None,
    names: list[str],
    forget: Forget,
    say: Callable[[str], None],
) -> int:
    """Checks that the results are those of the recipe, and removes damaged ones; the splats of a block."""
    if former is None:
        raise ScratchError(
            f"nothing tells what the results in {store} are of; begin anew with --overwrite, without --resume"
        )
    differences = recipe.differences(former.recipe)
    if differences:
        raise ScratchError(
            f"{store} has the results of another bake: {'; '.join(differences)}. Begin anew with --overwrite, without"
            " --resume"
        )
    sound = ordered_map(store.is_sound, names, 2)
    damaged = [name for name, is_sound in zip(names, sound, strict=True) if not is_sound]
    if damaged:
        for name in damaged:
            store.remove(name)
        forget(store, damaged)
    lost = f"; {count_of(len(damaged), 'other')} that a failure damaged will be made again" if damaged else ""
    say(f"goes on with {count_of(len(names) - len(damaged), 'result')} in {store}{lost}")
    return former.block_splats


def _folder_of(store: Store) -> Path | None:
    """The folder of a store on this machine."""
    place = store.folder if isinstance(store, FileStore) else None
    return place if isinstance(place, Path) else None


def _is_hopeless(error: BaseException) -> bool:
    return isinstance(error, HOPELESS) and not isinstance(error, UnreadableError)
