"""Proves a dataset: that it is whole and unchanged, and that the simulator and the tasks' rewards agree with every number in it.

A fingerprint shows that nothing changed since the dataset was made, but whoever changes the arrays can compute it anew. The simulator
cannot be talked round: episodes are repeated from their seeds, and rewards and coverage computed again from the states. What cannot be
computed again, such as who chose the actions, is named.
"""

from __future__ import annotations

import json
import math
import secrets
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NoReturn

import h5py
import numpy as np
from numpy.typing import NDArray

from cudc_bench import plugins
from cudc_bench.artefacts.ids import DatasetId, dataset_path, parse_id
from cudc_bench.artefacts.manifest import FieldHasher, Manifest, Mixture, exists, fingerprint, read_manifest, read_metadata
from cudc_bench.artefacts.provenance import same_arithmetic, versions
from cudc_bench.data.claims import contradictions, from_base, odd_environment, odd_parts, odd_tier, remarks
from cudc_bench.data.descriptors import Visits
from cudc_bench.data.layout import MAIN_FILE, has_reset_row
from cudc_bench.data.metadata import minari_metadata
from cudc_bench.data.mixing import draw_episodes, whole_episodes
from cudc_bench.data.reader import check_base, read_episodes, read_field
from cudc_bench.data.storage import LINKED, READ_ERRORS, behind_link, check_links, odd_values, open_field, row_kinds
from cudc_bench.data.writer import episode_attributes
from cudc_bench.envs import Domain, check_domain, check_tasks
from cudc_bench.envs.domains import DRIFT_SHARE, STEP_TOLERANCE
from cudc_bench.envs.playback import Drift, Fault, Playback
from cudc_bench.errors import CudcBenchError, RunError, UsageError
from cudc_bench.execution.progress import Advance, bars
from cudc_bench.files import check_regular
from cudc_bench.settings.config import config_hash

Array = NDArray[Any]
SAMPLE = 20_000

_METADATA = (
    "dataset_id", "data_format", "total_episodes", "total_steps", "observation_space", "action_space", "algorithm_name",
    "combined_datasets", "eval_env_spec",
)  # fmt: skip
_SIZES = 0.0501  # MB by which a stored size may differ: Minari's own functions round it to a tenth
# By how much coverage may differ where rounding does, which moves states between cells: so many cells, or this share of both.
_CELLS, _COVERAGE = 2, 0.01
# What other mathematical libraries may do to a reward of at most 1; where versions and processor are the same, nothing.
_REWARD_ROUNDING = 1e-6
_COVERED = "the coverage is that of its states"
_RESTORE = "restore it from a copy, or make it again with --overwrite"


@dataclass(frozen=True)
class Check:
    """One check that was passed: its name, and what was checked and how much of it."""

    name: str
    detail: str


@dataclass(frozen=True)
class Verification:
    """A dataset that passed.

    Attributes:
        dataset_id: which one.
        fingerprint: of its arrays, computed anew.
        checks: in the order in which they were made.
        proven: what they show, as parts of sentences.
        unproven: what the dataset says of itself that nothing here can show.
        seed: by which the simulated episodes were drawn; None where all were.
    """

    dataset_id: str
    fingerprint: str
    checks: tuple[Check, ...]
    proven: tuple[str, ...]
    unproven: tuple[str, ...]
    seed: int | None


def draw_seed() -> int:
    """A seed for the sample that nobody can know beforehand."""
    return secrets.randbits(32)


def verify(
    dataset_id: DatasetId | str, *, sample: int | None = SAMPLE, seed: int | None = None, root: str | Path | None = None
) -> Verification:
    """Prove a dataset.

    All arrays are read, hashed and checked, and all rewards and the coverage computed again. Of the transitions, about ``sample`` are held
    against the simulator, in whole episodes drawn at random; if a hash differs, all of them, to find the damage.

    Args:
        dataset_id: such as ``"walker/cudc-v0"``.
        sample: transitions to simulate; None takes all.
        seed: of the draw of these episodes; from the system's entropy unless given, so that nobody can make a dataset whose faults it
            leaves out.
        root: Minari's root unless given.

    Returns:
        What was checked, all of it passed.

    Raises:
        UsageError: there is no such dataset, it is not one of ours, or ``sample`` is less than 1.
        RunError: a check failed; the message names the check, the first failing episode and step, and what to do.
    """
    if sample is not None and sample < 1:
        raise UsageError(f"--sample takes 1 or more transitions, not {sample}; --all takes all.")
    if seed is not None and seed < 0:
        raise UsageError(f"--seed cannot be {seed}; it must be 0 or more.")
    checked = dataset_id if isinstance(dataset_id, DatasetId) else parse_id(dataset_id)
    place = None if root is None else Path(root)
    return _Verifier(checked, read_manifest(checked, place), sample, draw_seed() if seed is None else seed, place).run()


class _Verifier:
    """The checks of one dataset; each method is one, and returns what it checked."""

    def __init__(self, dataset_id: DatasetId, manifest: Manifest, sample: int | None, seed: int, root: Path | None) -> None:
        self._id, self._manifest, self._sample, self._seed, self._root = dataset_id, manifest, sample, seed, root
        self._path = dataset_path(dataset_id, root) / "data" / MAIN_FILE
        self._changed: list[str] = []
        self._proven: list[str] = []
        self._unproven: list[str] = []
        self._added: set[str] = set()

    def run(self) -> Verification:
        """Make all checks in order."""
        manifest = self._manifest
        checks = [Check("manifest", self._check_manifest())]
        if manifest.base is not None:
            checks.append(Check("base", self._check_base()))
        with ExitStack() as stack:
            with self._reading():
                check_regular(self._path)
                file = stack.enter_context(h5py.File(self._path, "r"))
                checks.append(Check("file", self._check_file(file)))
                with bars([(f"{self._id}: reading", manifest.episodes)], "episodes") as (advance,):
                    checks += self._check_arrays(file, advance)
            if any(seed is not None for seed in self._seeds):
                checks.append(Check("seeds", self._check_seeds(file)))
            if manifest.mixture is not None:
                checks.append(Check("mixture", self._check_mixture(file, manifest.mixture)))
            checks.append(Check("rewards", self._check_rewards(file)))
            checks.append(Check("simulation", self._check_simulation(file)))
            # Last, since it cannot say where.
            if (coverage := self._check_coverage(file)) is not None:
                checks.append(Check("coverage", coverage))
        if self._changed:
            self._fail("fingerprint", f"{', '.join(self._changed)} changed after it was made, by less than a simulation here can locate")
        self._proven.insert(0, "every array is the one that its manifest hashes")
        self._name_the_rest()
        sampled = len(self._chosen(check_domain(manifest.domain))) < manifest.episodes and "infos/physics" in manifest.fields
        seed = self._seed if sampled else None
        return Verification(str(self._id), manifest.fingerprint, tuple(checks), tuple(self._proven), tuple(self._unproven), seed)

    def _name_the_rest(self) -> None:
        """What no computation can show of any dataset, after what the checks found."""
        manifest = self._manifest
        if manifest.mixture is not None:
            self._unproven.append(f"that {', '.join(sorted({part.label for part in manifest.mixture.parts}))} chose the actions")
        elif manifest.imported is None:
            self._unproven.append(f"that {manifest.method} with these hyperparameters chose the actions")
            measured = "the diagnostics but for the coverage" if _COVERED in self._proven else "the diagnostics"
            measured = measured if manifest.tier is None else "the scores of its training"
            self._unproven.append(f"{measured}, and the final state" if manifest.final_state else measured)
        else:
            self._unproven.append(f"that {manifest.imported.source}'s {manifest.method} collected it")
        self._unproven += ["when, where, by whom and with which versions it was made", "descriptions and the card"]

    # ------------------------------------------------------------------------------------------------------------------------ failing

    def _fail(self, check: str, what: str, episode: int | None = None, step: int | None = None, remedy: str = "") -> NoReturn:
        place = "" if episode is None else f" in episode {episode}" if step is None else f" in episode {episode} at step {step}"
        # A hash that does not fit is the surer finding; what was found after it says where.
        if self._changed and check != "fingerprint":
            what = f"{', '.join(self._changed)} changed after it was made: {check}: {what}"
            check = "fingerprint"
        raise RunError(f"'{self._id}' fails the check '{check}'{place}: {what}; {remedy or self._remedy}.")

    @property
    def _remedy(self) -> str:
        if self._manifest.mixture is not None and self._manifest.base is None:
            return "mix its parts again with --overwrite"
        if self._manifest.imported is None or self._manifest.base is not None:
            return _RESTORE
        return "import its files again with --overwrite, and if that ends the same, ask who made them for whole ones"

    @contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        except CudcBenchError:
            raise
        except READ_ERRORS as error:
            words = (str(error).splitlines() or [type(error).__name__])[0]
            self._fail("file", f"{self._path} cannot be read, it is truncated or damaged ({words})")

    # ----------------------------------------------------------------------------------------------------------------------- manifest

    def _check_manifest(self) -> str:
        manifest = self._manifest
        fail = partial(self._fail, "manifest")
        try:
            facts = check_domain(manifest.domain)
            if manifest.task is not None and manifest.reward is None:
                check_tasks(facts, [manifest.task])
            expected = minari_metadata(self._path.parent, manifest, str(self._id), "")
        except UsageError as error:
            fail(str(error).rstrip("."))
        except OSError as error:
            self._fail("file", f"{self._path} cannot be read ({error.strerror})")
        if config_hash(manifest.hyperparameters) != manifest.hyperparameters_hash:
            fail("the hyperparameters do not fit their hash")
        if fingerprint(manifest.fields) != manifest.fingerprint:
            fail("the fingerprint is not that of the fields' hashes")
        if manifest.was_collected and manifest.hyperparameters.get("steps") != manifest.steps:
            fail(f"it has {manifest.steps:,} steps, but was collected with steps={manifest.hyperparameters.get('steps')!r:.40}")
        if not 1 <= manifest.episodes <= manifest.steps:
            fail(f"{manifest.steps:,} steps cannot form {manifest.episodes:,} episodes")
        if manifest.tier is not None and (what := odd_tier(manifest)) is not None:
            fail(what)
        if manifest.mixture is not None and (what := odd_parts(manifest, facts)) is not None:
            fail(what)
        missing = {"observations", "actions", "rewards", "terminations", "truncations"} - manifest.fields.keys()
        if missing:
            fail(f"it names no hash of {', '.join(sorted(missing))}")
        metadata = read_metadata(self._id, self._root)
        for key in _METADATA:
            there, wanted = metadata.get(key), expected.get(key)
            if there != wanted:
                fail(f"Minari's metadata have {key} {there!r:.99}, but by the manifest and the file it is {wanted!r:.99}")
        self._check_size(metadata.get("dataset_size"), expected["dataset_size"])
        self._check_environment(metadata.get("env_spec"), expected["env_spec"])
        for what in contradictions(manifest, facts):
            fail(what)
        if manifest.base is not None and manifest.base.linked and exists(manifest.base.id, self._root):
            base = read_manifest(manifest.base.id, self._root)
            if base.fingerprint == manifest.base.fingerprint and (other := list(from_base(manifest, base))):
                fail(f"it has other {', '.join(other)} than its base '{manifest.base.id}'")
        self._unproven += remarks(manifest)
        return f"{len(_METADATA) + 2} entries of Minari's metadata, hash of {len(manifest.hyperparameters)} hyperparameters, command"

    def _check_size(self, there: Any, found: float) -> None:
        if isinstance(there, bool) or not isinstance(there, int | float) or not abs(there - found) <= _SIZES:
            self._fail("manifest", f"Minari's metadata have dataset_size {there!r:.99}, but by the manifest and the file it is {found!r}")

    def _check_environment(self, there: Any, expected: str) -> None:
        """The environment's specification, read as data: whoever asks Minari for the environment has all that it names imported."""
        try:
            found = json.loads(there)
        except (ValueError, TypeError, RecursionError):
            found = there
        if (odd := odd_environment(found, json.loads(expected))) is not None:
            name, value, wanted = odd
            what = f"Minari's metadata have an env_spec whose {name} is {value!r:.99}, but by the manifest it is {wanted!r:.99}"
            self._fail("manifest", f"{what}; ask nobody for that environment (recover_environment would run what it names)")

    def _check_base(self) -> str:
        base = self._manifest.base
        assert base is not None
        if not base.linked:
            return f"copied from {base.id}, stands alone"
        try:
            check_base(self._manifest, self._id, self._root)
            there = read_manifest(base.id, self._root).fields
        except CudcBenchError as error:
            raise RunError(f"'{self._id}' fails the check 'base': {error}") from None
        other = sorted(name for name in self._manifest.fields if name != "rewards" and self._manifest.fields[name] != there.get(name))
        if other:
            self._fail("base", f"the hashes of {', '.join(other)} are not those of its base '{base.id}'")
        return f"{base.id} is there, with the fingerprint that it was made from"

    # --------------------------------------------------------------------------------------------------------------------------- file

    def _check_file(self, file: h5py.File) -> str:
        """Groups, members, links and sizes; no array is read."""
        manifest, fields = self._manifest, self._manifest.fields
        self._check_groups(file)
        linked = manifest.base is not None and manifest.base.linked
        own = [name for name in fields if not (linked and name.partition("/")[0] in LINKED)]
        # Nothing is followed before it is known where it leads.
        check_links(file, (), range(manifest.episodes))
        if manifest.base is not None and linked:
            with h5py.File(dataset_path(manifest.base.id, self._root) / "data" / MAIN_FILE, "r") as base:
                check_links(base, set(fields) - set(own), range(manifest.episodes))
        facts, steps = check_domain(manifest.domain), 0
        for index in range(manifest.episodes):
            group = file[f"episode_{index}"]
            self._check_members(file, group, own, index)
            length = self._check_attributes(group, facts, index)
            for field in fields:
                self._check_shape(group, field, length, facts, index)
            steps += length
        if steps != manifest.steps:
            self._fail("file", f"the manifest has {manifest.steps:,} steps, the file {steps:,}")
        more = f", attributes that we did not write: {', '.join(sorted(self._added))[:99]}" if self._added else ""
        return (
            f"{manifest.episodes:,} episodes of {len(fields)} fields, {steps:,} steps" + (", links into the base" if linked else "") + more
        )

    def _check_groups(self, file: h5py.File) -> None:
        """A group for each episode, and nothing else."""
        episodes, found = self._manifest.episodes, set(file.keys())
        if episodes - len(found) > 1000:  # before their names are made, of which a manifest may claim any number
            self._fail("file", f"the manifest has {episodes:,} episodes, the file {len(found):,} groups")
        if odd := sorted(found ^ {f"episode_{index}" for index in range(episodes)}):
            what = f"the manifest has {episodes:,} episodes, the file {len(found):,} groups ('{odd[0]:.40}' is in one of them only)"
            self._fail("file", what)

    def _check_members(self, file: h5py.File, group: h5py.Group, own: Sequence[str], index: int) -> None:
        """An episode's arrays, by name, and where links among them lead; ``own`` are fields that must lie in the file itself."""
        fields, base = self._manifest.fields, self._manifest.base
        members = {name.partition("/")[0] for name in fields}
        infos = {name.removeprefix("infos/") for name in fields if name.startswith("infos/")}
        fail = partial(self._fail, "file", episode=index)
        if set(group.keys()) != members:
            fail(f"it holds {', '.join(sorted(group.keys())):.99}, not {', '.join(sorted(members))}")
        check_links(file, {name.partition("/")[0] for name in own}, [index])
        for member in LINKED if base is not None and base.linked else ():
            self._check_link(group, member, index)
        if infos and not isinstance(group["infos"], h5py.Group):
            fail("its infos are no group")
        if infos and set(group["infos"].keys()) != infos:
            fail(f"its infos are {', '.join(sorted(group['infos'].keys())):.99}, not {', '.join(sorted(infos))}")
        check_links(file, own, [index])

    def _check_attributes(self, group: h5py.Group, facts: Domain, index: int) -> int:
        """An episode's length, number and other attributes; the length."""
        manifest, fail = self._manifest, partial(self._fail, "file", episode=index)
        length = int(group.attrs["total_steps"])
        last = index == manifest.episodes - 1
        # Files of other origin hold episodes of any length up to the limit.
        shortest = 1 if (last and manifest.mixture is None) or manifest.imported is not None else facts.episode_length
        if not shortest <= length <= facts.episode_length:
            fail(f"it has {length:,} steps; all but the last one have {facts.episode_length:,}")
        if int(group.attrs["id"]) != index:
            fail(f"it is stored as episode {int(group.attrs['id'])}")
        ours = episode_attributes(index, self._seeds[index], np.zeros(1))
        self._added |= {str(key) for key in group.attrs} - ours.keys()
        for key in ours:
            if np.ndim(group.attrs[key]) or np.asarray(group.attrs[key]).dtype.kind not in "iuf":
                fail(f"its attribute {key} is no number")
        return length

    def _check_link(self, group: h5py.Group, member: str, index: int) -> None:
        base = self._manifest.base
        assert base is not None
        if member not in group and member == "infos":
            return
        link = group.get(member, getlink=True)
        wanted = dataset_path(base.id, self._root) / "data" / MAIN_FILE
        if not isinstance(link, h5py.ExternalLink) or link.path != f"/episode_{index}/{member}":
            self._fail("base", f"{member} is no link to episode {index} of '{base.id}'", index)
        target = self._path.parent / link.filename
        if not (target.exists() and target.samefile(wanted)):
            behind = behind_link(self._path, link.filename, wanted)
            self._fail("base", behind or f"{member} links to {link.filename!r:.99}, which is not '{base.id}'", index)

    def _check_shape(self, group: h5py.Group, field: str, length: int, facts: Domain, index: int) -> None:
        dataset = open_field(group, field)
        rows = length + 1 if has_reset_row(field) else length
        dtype, shape = row_kinds(facts).get(field, (dataset.dtype, dataset.shape[1:]))
        if dataset.dtype != np.dtype(dtype) or dataset.shape != (rows, *shape):
            self._fail("file", f"{field} is {dataset.dtype} {dataset.shape}, not {np.dtype(dtype)} {(rows, *shape)}", index)

    # ------------------------------------------------------------------------------------------------------------------------- arrays

    def _check_arrays(self, file: h5py.File, advance: Advance) -> list[Check]:
        """One pass over all arrays: numbers, bounds, ends, hashes."""
        manifest, hasher, numbers = self._manifest, FieldHasher(), 0
        for index in range(manifest.episodes):
            group = file[f"episode_{index}"]
            for field in manifest.fields:
                array = read_field(group, field)
                hasher.update(field, array)
                numbers += array.size
                for check, what, row in odd_values(field, array):
                    self._fail(check, what, index, row)
                if field in {"terminations", "truncations"}:
                    expected = np.zeros(len(array), np.uint8)
                    expected[-1] = field == "truncations"
                    what = f"{field} are not False" + (" but at the last step" if field == "truncations" else "")
                    self._check_each(array.view(np.uint8) == expected, "ends", what, index)
            advance(1)
        found = hasher.digests()
        self._changed = [field for field, digest in found.items() if digest != manifest.fields[field]]
        return [
            Check("numbers", f"{numbers:,}, all finite"),
            Check("actions", f"{manifest.steps:,}, all within [-1, 1]"),
            Check("ends", f"{manifest.episodes:,} truncations, each at the last step, no termination"),
            Check("fingerprint", f"{manifest.fingerprint[:16]}… from {len(found)} fields"),
        ]

    def _check_each(self, good: Array, check: str, what: str, index: int) -> None:
        rows = good.reshape(len(good), -1).all(axis=1)
        if not rows.all():
            self._fail(check, what, index, int(np.flatnonzero(~rows)[0]))

    def _check_seeds(self, file: h5py.File) -> str:
        manifest = self._manifest
        known = {index: seed for index, seed in enumerate(self._seeds) if seed is not None}
        for index, expected in known.items():
            found = int(file[f"episode_{index}"].attrs["seed"])
            if found != expected:
                whose = f"seed {manifest.seed} of the manifest" if manifest.mixture is None else "the seed of its part"
                self._fail("seeds", f"the stored seed is {found}, but {whose} gives {expected}", index)
        whose = f"of seed {manifest.seed} for its episode" if manifest.mixture is None else "of its part's seed for its episode there"
        return f"{len(known):,}, each that {whose}"

    @cached_property
    def _seeds(self) -> list[int | None]:
        """With which each episode's environment was reset, where that is known."""
        return [self._manifest.episode_seed(index) for index in range(self._manifest.episodes)]

    # ------------------------------------------------------------------------------------------------------------------------ mixture

    def _check_mixture(self, file: h5py.File, mixture: Mixture) -> str:
        """Each part that is here: that the seed draws these episodes of it, and that they equal its own."""
        fields, facts = tuple(name for name in self._manifest.fields if name != "rewards"), check_domain(self._manifest.domain)
        compared, absent = 0, []
        for place, part in enumerate(mixture.parts):
            try:
                here = read_manifest(part.id, self._root).fingerprint == part.fingerprint
            except CudcBenchError:
                here = False
            if not here:
                absent.append(part.id)
                continue
            whole = whole_episodes(part.id, facts, self._root)
            if part.episodes != draw_episodes(whole, len(part.episodes), self._manifest.seed, part.fingerprint):
                self._fail("mixture", f"seed {self._manifest.seed} draws other episodes of '{part.id}'")
            for number, theirs in enumerate(read_episodes(part.id, fields, self._root, episodes=part.episodes)):
                index = number * len(mixture.parts) + place
                for name, array in theirs.items():
                    ours = read_field(file[f"episode_{index}"], name)
                    what = f"{name} are not those of episode {part.episodes[number]} of '{part.id}'"
                    if ours.shape != array.shape or ours.dtype != array.dtype:
                        self._fail("mixture", what, index)
                    self._check_each(ours.view(f"u{ours.itemsize}") == array.view(f"u{array.itemsize}"), "mixture", what, index)
            compared += len(part.episodes)
        if compared:
            self._proven.append(f"{compared:,} of {self._manifest.episodes:,} episodes are those that its seed draws of its parts")
        if absent:
            self._unproven.append(f"that its other episodes are those of {', '.join(absent)}: not here with the fingerprints that it names")
        return f"{compared:,} of {self._manifest.episodes:,} episodes equal those of the parts that are here, as its seed draws them"

    # ------------------------------------------------------------------------------------------------------------------------ rewards

    def _check_rewards(self, file: h5py.File) -> str:
        manifest = self._manifest
        expected, how = self._recompute()
        tolerance = 0.0 if manifest.task is None or same_arithmetic(manifest.versions, manifest.machine) else _REWARD_ROUNDING
        if expected is not None:
            with bars([(f"{self._id}: rewards", manifest.episodes)], "episodes") as (advance,):
                for index in range(manifest.episodes):
                    self._check_reward_rows(file[f"episode_{index}"], expected, tolerance, index)
                    advance(1)
        for index in range(manifest.episodes):
            group = file[f"episode_{index}"]
            for name, value in episode_attributes(index, None, read_field(group, "rewards")).items():
                found = float(group.attrs[name])
                if not math.isclose(found, value, rel_tol=1e-9, abs_tol=1e-9):
                    self._fail("rewards", f"the attribute {name} is {found:g}, but by the rewards {value:g}", index)
        if tolerance and expected is not None:
            how += f" within {tolerance:g} (made with other versions or on another processor)"
        if expected is not None:
            self._proven.append("its rewards are all 0" if manifest.task is None else f"its rewards are those of {manifest.task}")
        return f"{manifest.steps:,}, {how}"

    def _recompute(self) -> tuple[Callable[[h5py.Group], Array] | None, str]:
        """How an episode's rewards (T,) are computed, if they can be, and a word about it."""
        manifest = self._manifest
        if manifest.task is None:
            return lambda group: np.zeros(int(group.attrs["total_steps"]), np.float32), "all 0: it belongs to no task"
        if manifest.base is None and manifest.tier is None:
            self._unproven.append(f"that its rewards are those of {manifest.task}: they were imported")
            return None, "as they were imported; not computed again"
        if manifest.reward is not None:
            # Whoever made the dataset chose the name; reading a dataset must not run code.
            self._unproven.append(f"its rewards, by the function {manifest.reward.reference}: relabel its base with it and compare")
            return None, f"by the function {manifest.reward.reference}, which is not run here"
        if "infos/physics" not in manifest.fields:
            self._fail("rewards", f"it has rewards of {manifest.task} but no physics states to compute them from")
        facts = check_domain(manifest.domain)
        relabeler, column = plugins.load("relabelers", facts.relabeler)(facts), facts.tasks.index(manifest.task)

        def rewards(group: h5py.Group) -> Array:
            computed = relabeler.rewards(read_field(group, "infos/physics")[1:], read_field(group, "actions"))
            return np.asarray(computed[:, column], np.float32)

        return rewards, f"equal to {manifest.task} computed from the states"

    def _check_reward_rows(self, group: h5py.Group, expected: Callable[[h5py.Group], Array], tolerance: float, index: int) -> None:
        there, computed = read_field(group, "rewards"), expected(group)
        wrong = np.flatnonzero(~(np.abs(there.astype(np.float64) - computed) <= tolerance))
        if len(wrong):
            step = int(wrong[0])
            what = f"the reward is {there[step]:.9g}, but the state that action {step} leads to has {computed[step]:.9g}"
            if self._manifest.task is None:
                what = f"the reward is {there[step]:.9g}, but a dataset without a task has 0"
            self._fail("rewards", what, index, step, _RESTORE if self._manifest.base is None else "relabel its base again with --overwrite")

    # ----------------------------------------------------------------------------------------------------------------------- coverage

    def _check_coverage(self, file: h5py.File) -> str | None:
        """The coverage that the diagnostics state, from the states; None where they state none, or the base has been asked."""
        manifest = self._manifest
        stated = {name: manifest.diagnostics.get(name) for name in ("coverage_cells", "coverage_entropy")}
        facts = check_domain(manifest.domain)
        if all(value is None for value in stated.values()) or (manifest.base is not None and manifest.base.linked):
            return None
        if not facts.descriptors or "infos/physics" not in manifest.fields:
            self._fail("coverage", "its diagnostics state a coverage that nobody can have measured")
        relabeler, visits = plugins.load("relabelers", facts.relabeler)(facts), Visits(facts)
        with bars([(f"{self._id}: coverage", manifest.episodes)], "episodes") as (advance,):
            for index in range(manifest.episodes):
                group = file[f"episode_{index}"]
                visits.add(relabeler.quantities(read_field(group, "infos/physics")[1:], read_field(group, "actions")))
                advance(1)
        found, share = visits.coverage.as_row(), 0.0 if self._exact else _COVERAGE
        for name, value in stated.items():
            slack = max(share * found[name], _CELLS if share and name == "coverage_cells" else 1e-9)
            if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value - found[name]) <= slack:
                self._fail("coverage", f"its diagnostics have {name} {value!r:.40}, but its states {found[name]}")
        self._proven.append(_COVERED)
        return f"{found['coverage_cells']:,} cells, entropy {found['coverage_entropy']:.6g}, as the diagnostics have it"

    # --------------------------------------------------------------------------------------------------------------------- simulation

    @cached_property
    def _exact(self) -> bool:
        """Whether states and observations were made by the arithmetic of this machine, so that every bit of them must be the same."""
        manifest = self._manifest
        if manifest.imported is not None:
            return False
        if manifest.collected is not None:
            return same_arithmetic(manifest.collected.versions, manifest.collected.machine)
        if manifest.base is None:
            return same_arithmetic(manifest.versions, manifest.machine)
        if not exists(manifest.base.id, self._root):
            return False
        base = read_manifest(manifest.base.id, self._root)
        return base.fingerprint == manifest.base.fingerprint and same_arithmetic(base.versions, base.machine)

    def _is_exact(self, index: int) -> bool:
        """The same of one episode: those of a mixture were made with what its part was."""
        if self._manifest.mixture is None:
            return self._exact
        part, _ = self._manifest.mixture.origin(index)
        return part.source is None and same_arithmetic(part.collected.versions, part.collected.machine)

    def _check_simulation(self, file: h5py.File) -> str:
        manifest = self._manifest
        if "infos/physics" not in manifest.fields:
            self._unproven.append("that its observations follow from its actions: it holds no physics states")
            return "none: it holds no physics states"
        facts = check_domain(manifest.domain)
        playback, chosen = Playback(facts), self._chosen(facts)
        exact, steps, slips, drifts = 0, 0, list[tuple[int, Fault]](), list[Drift]()
        with bars([(f"{self._id}: simulating", len(chosen))], "episodes") as (advance,):
            for index in chosen:
                group = file[f"episode_{index}"]
                seed = None if self._seeds[index] is None else int(group.attrs["seed"])
                actions = read_field(group, "actions")
                arrays = read_field(group, "infos/physics"), actions, read_field(group, "observations")
                verdict = playback.test(seed, *arrays, exact=self._is_exact(index))
                if verdict.fault is not None:
                    why = ", bit for bit as it must be here: by its manifest this processor and these versions made it"
                    self._fail("simulation", verdict.fault.what + (why if self._is_exact(index) else ""), index, verdict.fault.row)
                exact, steps = exact + (verdict.inexact is None), steps + len(actions)
                if verdict.inexact is not None:
                    slips.append((index, verdict.inexact))
                if verdict.drift is not None:
                    drifts.append(verdict.drift)
                advance(1)
        if self._changed and exact and slips:
            # This machine repeats other episodes to the last bit: the first that it does not is where the change is.
            index, slip = slips[0]
            self._fail("simulation", slip.what, index, slip.row)
        self._check_drift(drifts, facts)
        share = "all" if len(chosen) == manifest.episodes else f"of {manifest.steps:,}, drawn with --seed {self._seed}"
        parts = [f"{exact:,} episodes repeated from their seeds bit for bit"] if exact else []
        if drifts:
            parts.append(self._followed(drifts, facts))
        self._conclude(exact, len(drifts))
        return f"{steps:,} transitions ({share}): {', '.join(parts)}"

    def _check_drift(self, drifts: Sequence[Drift], facts: Domain) -> None:
        """Many episodes that are each pulled as far as one may be are not rounding."""
        if not drifts:
            return
        mean, share = float(np.mean([drift.accumulated for drift in drifts])), DRIFT_SHARE + (1.0 - DRIFT_SHARE) / len(drifts)
        if mean > (limit := share * facts.drift_tolerance):
            what = f"the errors of {len(drifts):,} episodes add up to {mean:.3g} on the average, where rounding makes {limit:.3g} at most"
            self._fail("simulation", f"{what}: they were pulled away from the simulation")

    def _followed(self, drifts: Sequence[Drift], facts: Domain) -> str:
        beyond, worst = sum(drift.beyond for drift in drifts), max(drift.accumulated for drift in drifts)
        text = f"{len(drifts):,} episodes step by step within {STEP_TOLERANCE:g}"
        if beyond:
            steps, largest = sum(drift.steps for drift in drifts), max(drift.largest for drift in drifts)
            text += (
                f" but for {beyond:,} of {steps:,} steps, at most {largest:.2g}: contacts, or another MuJoCo than {versions()['mujoco']}"
            )
        why = "their seeds are not known" if self._unseeded else "rounding differs here"
        return f"{text} ({why}); errors add up to {worst:.2g} in an episode, of {facts.drift_tolerance:g} allowed"

    @property
    def _unseeded(self) -> bool:
        return None in self._seeds

    def _conclude(self, exact: int, followed: int) -> None:
        """What the simulation showed, in a few words."""
        episodes = self._manifest.episodes
        if exact:
            self._proven.append(f"{exact:,} of {episodes:,} episodes are, bit for bit, what their seeds and actions lead to")
        if followed:
            self._proven.append(f"{followed:,} of {episodes:,} episodes are, up to rounding, what their actions lead to")
            made = self._manifest.collected or self._manifest
            where = f"made on {made.machine.get('processor', 'an unknown processor')}, MuJoCo {made.versions.get('mujoco', 'unknown')}"
            what = "how its episodes began, and the last digits of states" if self._unseeded else f"the last digits of states ({where})"
            self._unproven.append(what)
        if (left := episodes - exact - followed) > 0:
            self._unproven.append(f"{left:,} of {episodes:,} episodes, which were not simulated (--all)")

    def _chosen(self, facts: Domain) -> list[int]:
        """The episodes to simulate, in order."""
        episodes = self._manifest.episodes
        if self._sample is None or self._changed:
            return list(range(episodes))
        count = min(episodes, -(-self._sample // facts.episode_length))
        generator = np.random.default_rng(self._seed)
        return sorted(int(index) for index in generator.choice(episodes, count, replace=False))
