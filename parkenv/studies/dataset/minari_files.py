"""Data sets in Minari's format, made and read through Minari; searches wait in `.npz` files until all are there."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from parkenv.errors import InputError, needs_extra
from parkenv.files.archives import read_arrays
from parkenv.files.atomic_write import atomic_write
from parkenv.studies.dataset.recording import PROBABILITIES, RecordedSearch
from parkenv.studies.results import Row
from parkenv.version import __version__

PARTS = ".parts"
"""Folder in that of a run with the searches that are in no data set yet."""
TORN = ".minari-"
"""How the names of folders begin in which data sets are written; killed processes leave them."""
_MOST_BYTES = 1 << 33  # of a part


def require_minari() -> None:
    """Check that Minari and its HDF5 storage are installed.

    Raises:
        InputError: one of them is missing.
    """
    try:
        import_module("minari.dataset._storages.hdf5_storage")
    except ImportError as error:
        raise InputError(f"{needs_extra('a data set', 'offline')} ({error})") from error


def write_part(folder: Path, searches: Sequence[RecordedSearch]) -> None:
    """Write searches of successive seeds into a file of a folder, atomically."""
    about = [(each.seed, each.agent, len(each.arrays["actions"])) for each in searches]
    arrays = dict(zip(("seed", "agent", "steps"), map(np.array, zip(*about, strict=True)), strict=True))
    for name in searches[0].arrays:
        arrays[name.replace("/", "-")] = np.concatenate([each.arrays[name] for each in searches])
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{searches[0].seed}-{searches[-1].seed}.npz"
    with atomic_write(file) as beside, beside.open("wb") as opened:
        np.savez(opened, **arrays)  # type: ignore[arg-type]


def seeds_in(folder: Path) -> Iterator[tuple[Path, range]]:
    """Yield the files of `write_part` in a folder with their seeds, in order."""
    found = ((file, [int(end) for end in file.stem.split("-")]) for file in folder.glob("*.npz"))
    for file, (first, last) in sorted(found, key=lambda each: each[1]):
        yield file, range(first, last + 1)


def _read_part(file: Path) -> Iterator[tuple[int, str, int, dict[str, Any]]]:
    """Yield seed, agent, steps and arrays of the searches in a file."""
    part = read_arrays(file, _MOST_BYTES)
    about, n = [part.pop(name) for name in ("seed", "agent", "steps")], len(part["actions"])
    ends = np.cumsum(about[2])
    # Observations have a row more than steps in each search.
    further = {name: (len(values) > n) * np.arange(1, len(ends) + 1) for name, values in part.items()}
    split = {name.replace("-", "/"): np.split(part[name], (ends + further[name])[:-1]) for name in part}
    for i, (seed, agent, steps) in enumerate(zip(*(each.tolist() for each in about), strict=True)):
        yield seed, agent, steps, {name: its[i] for name, its in split.items()}


def episodes_in(root: Path, name: str) -> int:
    """Return how many episodes the data set of a name has; 0 if there is none.

    Raises:
        InputError: Minari cannot read it.
    """
    data = root / name / "data"
    if not data.exists():
        return 0
    from minari import MinariDataset

    try:
        return int(MinariDataset(data).total_episodes)
    except (OSError, ValueError, KeyError, AssertionError) as error:
        raise InputError(f"{data}: Minari cannot read it: {error}") from error


@dataclass(frozen=True)
class DatasetFile:
    """A data set to write.

    Attributes:
        root: folder of the run, a root of Minari's data sets.
        name: Minari's name of the data set.
        n: number of episodes.
        seed: seed of the first one; the others count up.
        env: arguments of `gymnasium.make("parkenv/Search-v2")`.
        about: what the metadata say besides; `policy`, `scenario` and `epsilon` are part of it.
    """

    root: Path
    name: str
    n: int
    seed: int
    env: Row
    about: Row

    def write(self) -> None:
        """Write the data set, after what an earlier one of the name holds; it appears whole or not at all."""
        if episodes_in(self.root, self.name) < self.n:
            with tempfile.TemporaryDirectory(prefix=TORN, dir=self.root) as beside:
                new, old, final = Path(beside) / "new", Path(beside) / "old", self.root / self.name
                if final.exists():
                    shutil.copytree(final, new)
                self._extend(new / "data")
                final.parent.mkdir(parents=True, exist_ok=True)
                for parent in (final.parent, final.parent.parent):
                    (parent / "namespace_metadata.json").write_text("{}")
                if final.exists():
                    final.rename(old)
                new.rename(final)
        for file, seeds in list(seeds_in(self.root / PARTS / self.name)):
            if seeds[-1] < self.seed + self.n:
                file.unlink()

    def _extend(self, data: Path) -> None:
        from minari import __version__ as minari_version
        from minari.dataset.minari_storage import MinariStorage

        if data.exists():
            storage = MinariStorage.read(data)
        else:
            data.mkdir(parents=True)
            env = gym.make("parkenv/Search-v2", **self.env)
            storage = MinariStorage.new(data, env.observation_space, env.action_space, env.spec)
            storage.update_metadata({"dataset_id": self.name, "minari_version": minari_version})
        steps, about = self._append(data / "main_data.hdf5", storage.total_episodes), self.about
        storage.update_metadata(
            {
                "total_episodes": self.n,
                "total_steps": storage.total_steps + steps,
                "dataset_size": storage.get_size(),
                "algorithm_name": about["policy"],
                "author": {"parkenv"},
                "description": f"Searches for a parking space in {about['scenario']}, by {about['policy']} with a "
                f"random action in a share of {about['epsilon']:g} of the steps. The return is minus the total time, "
                f"s. {PROBABILITIES}: of each action at each observation.",
                "requirements": [f"parkenv=={__version__}"],
                "parkenv": {"version": __version__, "seed": self.seed, **about},
            }
        )

    def _append(self, file: Path, done: int) -> int:
        """Append the episodes from index `done` on; return their number of steps.

        Minari's own writer gives every array room for 1,024 rows: 23 kB an episode, and three times the time.
        """
        import h5py
        from h5py import h5d, h5p, h5s, h5t

        nested = h5p.create(h5p.LINK_CREATE)
        nested.set_create_intermediate_group(True)
        timeless = h5p.create(h5p.DATASET_CREATE)
        timeless.set_obj_track_times(False)  # equal runs write equal files
        wanted, total = range(self.seed + done, self.seed + self.n), 0
        parts = [part for part, seeds in seeds_in(self.root / PARTS / self.name) if seeds[-1] >= wanted.start]
        with h5py.File(file, "a") as opened:
            for seed, agent, steps, arrays in (each for part in parts for each in _read_part(part)):
                if seed not in wanted:
                    continue
                group, total = opened.create_group(f"episode_{seed - self.seed}"), total + steps
                about = {"id": seed - self.seed, "seed": seed, "total_steps": steps, "agent": agent}
                for name, value in about.items():
                    group.attrs[name] = value
                for name, array in arrays.items():
                    kind, space = h5t.py_create(array.dtype, logical=True), h5s.create_simple(array.shape)
                    made = h5d.create(group.id, name.encode(), kind, space, timeless, lcpl=nested)
                    made.write(h5s.ALL, h5s.ALL, np.ascontiguousarray(array))
        return total
