"""Methods that can be compared, by name: each a dataclass of its parameters that recovers a trial's points.

To add one, write a dataclass with ``label``, ``sees`` and ``recover`` (or, if it returns an ``Attack``, ``build``) and
list it in ``CONTENDERS``. A user's own method needs no entry: ``{name: call, path: package.module:callable}``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from omegaconf import MISSING, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from eval.contract import LINE_SCHEMES, Contender, Peer, Trial, check_sight, settle_sight
from l2p.attacks.attack import Attack
from l2p.attacks.by_scheme import by_own_attack, recover_own
from l2p.attacks.learned import checkpoint
from l2p.attacks.learned.learned import Learned
from l2p.attacks.named import imported, named_attack
from l2p.attacks.settings import ATTACKS, DEFAULT_METHOD, METHODS
from l2p.checks import finite_rows
from l2p.errors import InputError
from l2p.io.kinds import Kind, kind_of
from l2p.io.recovery_files import load_recovery
from l2p.io.scene_files import load_scene
from l2p.judging.references import RULES, CandidateOracle, LeaveOneOut, Oracle, check_oracle, known_at_sight
from l2p.maps.appearance import Appearance
from l2p.maps.lines import LineCloud
from l2p.maps.recovery import Recovery
from l2p.programs.scenes import PAPER_KIND

#: Parameters that records of earlier versions lack, and the values that these versions had.
_LATER: dict[str, Any] = {"calibrated": None, "sees": (), "rule": RULES[0], "checkpoint": None}


@dataclass(frozen=True)
class AttackContender(Peer):
    """Attack by its name, or a user's own by ``package.module:Attack``.

    Attacks of l2p get the true fraction and kind of scene, unless ``settings`` has other values.
    """

    name: str = ""
    settings: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        settle_sight(self, self.name.rpartition(":")[2])
        check_sight(self, named_attack(self.name, **self.settings))  # refused before any work

    def uses(self, appearance: Appearance) -> tuple[str, ...]:
        """Return what the attack says that it uses."""
        return named_attack(self.name, **self.settings).uses(appearance)

    def serves(self, scheme: str) -> bool:
        """Return whether the attack was made for such maps."""
        if self.name == "published":
            return scheme.startswith(("ppl", "rays")) or scheme == "half-space"
        return scheme in LINE_SCHEMES or self.name == DEFAULT_METHOD

    def recover(self, trial: Trial) -> Recovery:
        """Build, then run; maps that are not of lines, or of one centre, have an attack of their own."""
        if by_own_attack(trial.lines, self.name, self.settings):
            return recover_own(trial.lines)
        return super().recover(trial)

    def build(self, trial: Trial) -> Attack:
        """Build the attack for this trial."""
        known = {"fraction": trial.fraction, "scene_kind": PAPER_KIND[trial.kind]}
        names = ATTACKS[self.name].names if self.name in ATTACKS else ()
        own = {name: value for name, value in known.items() if name in names}
        return named_attack(self.name, **{**own, **self.settings})

    def files(self, cloud: str) -> dict[str, str]:
        """Return the digest of the checkpoint."""
        if "checkpoint" not in (ATTACKS[self.name].names if self.name in ATTACKS else ()):
            return {}
        return {"digest": checkpoint.digest(self.settings.get("checkpoint") or checkpoint.shipped())}


@dataclass(frozen=True)
class OracleContender(Peer):
    """Oracle with the true neighbours, a share of them replaced by random lines; ``rule`` places the points."""

    k: int = 50
    outliers: float = 0.0
    rule: str = RULES[0]
    knows_truth: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_oracle(self.k, self.outliers, self.rule)
        wrong = f", {self.outliers:.0%} outliers" if self.outliers else ""
        rule = "" if self.rule == RULES[0] else f", {self.rule.replace('_', ' ')}"
        settle_sight(self, f"oracle {self.k}{wrong}{rule}")
        check_sight(self)

    def build(self, trial: Trial) -> Attack:
        """Build the oracle; its outliers follow from the seed of the lifting."""
        return Oracle(trial.truth, self.k, self.outliers, trial.seed, self.rule)


@dataclass(frozen=True)
class CandidateOracleContender(Peer):
    """Oracle with the true neighbours among the candidates of an attack, by default of the heuristic."""

    k: int = 50
    candidates: int = 200
    attack: dict[str, Any] = field(default_factory=lambda: {"name": "heuristic"})
    knows_truth: ClassVar[bool] = True

    def __post_init__(self) -> None:
        settle_sight(self, f"candidate oracle {self.k}")
        if "sees" in self.attack:
            raise InputError(f"got sees of the attack of {self.label}; expected it beside candidate_oracle itself")
        if self.sees:
            self._peer()  # refused before any work

    def uses(self, appearance: Appearance) -> tuple[str, ...]:
        """Return what the attack uses."""
        return self._peer().uses(appearance)

    def build(self, trial: Trial) -> Attack:
        """Build the oracle on the candidates of the attack."""
        return CandidateOracle(trial.truth, self._peer().build(trial), self.k, self.candidates)

    def files(self, cloud: str) -> dict[str, str]:
        """Return the digests of the attack."""
        return self._peer().files(cloud)

    def _peer(self) -> Peer:
        attack = contender_of({**self.attack, "sees": list(self.sees)})
        if not isinstance(attack, Peer):
            raise InputError(f"got attack {self.attack}; expected a method of l2p, whose estimates give candidates")
        return attack


@dataclass(frozen=True)
class LeaveOneOutContender(Peer):
    """Leave-one-out bound: all other points are known, and how they look, if it sees that.

    ``checkpoint``: the learned attack whose embedding it sees by; None for the one that l2p ships.
    """

    k: int = 128
    checkpoint: str | None = None
    knows_truth: ClassVar[bool] = True

    def __post_init__(self) -> None:
        settle_sight(self, "LOO")
        if self.checkpoint is not None and not self.sees:
            raise InputError(f"got a checkpoint for {self.label}, which sees nothing by it; leave it out, or give sees")
        if self.sees:
            check_sight(self, self._embedding())

    def build(self, trial: Trial) -> Attack:
        """Build the bound for these points."""
        return LeaveOneOut(trial.truth, self.k, self._embedding() if self.sees else None)

    def uses(self, appearance: Appearance) -> tuple[str, ...]:
        """Return what the embedding knows."""
        return known_at_sight(self._embedding(), appearance) if self.sees else ()

    def files(self, cloud: str) -> dict[str, str]:
        """Return the digest of the checkpoint, if it sees anything by it."""
        return {"digest": checkpoint.digest(self._file())} if self.sees else {}

    def _embedding(self) -> Learned:
        return checkpoint.load(self._file())

    def _file(self) -> str | Path:
        return checkpoint.shipped() if self.checkpoint is None else self.checkpoint


@dataclass(frozen=True)
class UserAttackContender(AttackContender):
    """User's :class:`l2p.attacks.attack.Attack` at ``path``, ``package.module:Attack``, with its ``settings``."""

    path: str = MISSING

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", self.path)
        super().__post_init__()


@dataclass(frozen=True)
class CallContender:
    """User's callable that takes a LineCloud and ``arguments`` and returns points (lines, 3) or a Recovery.

    ``calibrated``: whether the confidence is a probability; None to use the value in the Recovery.
    """

    path: str
    label: str = ""
    arguments: dict[str, Any] = field(default_factory=dict)
    calibrated: bool | None = None
    sees: tuple[str, ...] = ()
    knows_truth: ClassVar[bool] = False
    timed: ClassVar[bool] = True

    def __post_init__(self) -> None:
        settle_sight(self, self.path.rpartition(":")[2])
        imported(self.path)

    def uses(self, appearance: Appearance) -> tuple[str, ...]:
        """Return all that there is: the lines bring it to the callable."""
        return appearance.names

    def serves(self, scheme: str) -> bool:
        """Return True: what it can do is up to its author."""
        return True

    def recover(self, trial: Trial) -> Recovery:
        """Call it with the lines and ``arguments``, without the truth."""
        answer = imported(self.path)(trial.lines, **self.arguments)
        return as_recovery(answer, trial.lines, self.path, self.calibrated)

    def files(self, cloud: str) -> dict[str, str]:
        """Return no digests: its code is not an input, but is judged anew when it changes (:func:`source_of`)."""
        return {}


@dataclass(frozen=True)
class FolderContender:
    """Recoveries, or bare points in the order of the lines, by other programs: ``FOLDER/SCENE_PERCENT_SEED.npz`` for
    the lines of ``l2p lift --fraction F --seed S``.

    ``calibrated``: whether the confidence is a probability; None to use the value in the files. ``sees``: what these
    programs knew besides the lines.
    """

    path: str
    label: str = ""
    calibrated: bool | None = None
    sees: tuple[str, ...] = ()
    knows_truth: ClassVar[bool] = False
    timed: ClassVar[bool] = False

    def __post_init__(self) -> None:
        settle_sight(self, Path(self.path).name)

    def uses(self, appearance: Appearance) -> tuple[str, ...]:
        """Return all that there is: the other programs are taken at their word."""
        return appearance.names

    def serves(self, scheme: str) -> bool:
        """Return True: the files are taken as they are."""
        return True

    def recover(self, trial: Trial) -> Recovery:
        """Read the recovery; bare points all get the same confidence."""
        file = self._file(trial.key)
        bare = kind_of(file) is Kind.SCENE_NPZ
        answer = load_scene(file).xyz if bare else load_recovery(file)
        return as_recovery(answer, trial.lines, str(file), self.calibrated)

    def files(self, cloud: str) -> dict[str, str]:
        """Return the digest of the recovery."""
        file = self._file(cloud)
        return {"digest": checkpoint.digest(file) if file.is_file() else "no file"}

    def _file(self, cloud: str) -> Path:
        return Path(self.path) / f"{cloud}.npz"


#: Every method that a config may name, in addition to the attacks of l2p.
CONTENDERS: dict[str, type[Any]] = {
    "oracle": OracleContender,
    "candidate_oracle": CandidateOracleContender,
    "loo": LeaveOneOutContender,
    "attack": UserAttackContender,
    "call": CallContender,
    "folder": FolderContender,
}


def contenders_of(entries: list[dict[str, Any]]) -> tuple[Contender, ...]:
    """Build the methods of a config, whose labels must differ."""
    contenders = tuple(contender_of(entry) for entry in entries)
    labels = [contender.label for contender in contenders]
    for label in labels:
        if labels.count(label) > 1:
            raise InputError(f"got {labels.count(label)} methods with the label {label!r}; give each its own label")
    return contenders


def contender_of(entry: dict[str, Any]) -> Contender:
    """Build the method of one entry of a config.

    Raises
    ------
    InputError
        If the name or a parameter is unknown or of another type.
    """
    name = entry.get("name")
    if name not in CONTENDERS and name not in ATTACKS:
        raise InputError(f"got method {name!r}; expected a name of {', '.join((*METHODS, *CONTENDERS))}")
    parameters = {key: value for key, value in entry.items() if key != "name"}
    try:
        if name in ATTACKS:
            settings = {key: value for key, value in parameters.items() if key not in ("label", "sees")}
            checked: Any = OmegaConf.merge(OmegaConf.structured(ATTACKS[name].settings), settings)
            given = {key: checked[key] for key in settings if checked[key] is not None}
            return AttackContender(parameters.get("label") or "", parameters.get("sees", ()), name, given)
        return OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(CONTENDERS[name]), parameters))  # type: ignore[return-value]
    except OmegaConfBaseException as error:
        sentence = str(error).splitlines()[0]
        raise InputError(f"got parameters {parameters} for method {name}: {sentence}") from error


def identity_of(contender: Contender, cloud: str) -> dict[str, Any]:
    """Return all inputs of a prediction for that line cloud except the code: parameters, and digests of files."""
    parameters = _parameters(contender)
    for name, default in _LATER.items():
        if name in parameters and parameters[name] == default:
            del parameters[name]
    return {"class": type(contender).__name__, **parameters, **contender.files(cloud)}


def source_of(contender: Contender) -> str | None:
    """Return a digest of the file that a user's method is in; None for methods of l2p, or without a file."""
    if not isinstance(contender, CallContender | UserAttackContender):
        return None
    found = find_spec(contender.path.partition(":")[0])
    file = None if found is None or found.origin is None else Path(found.origin)
    return checkpoint.digest(file) if file is not None and file.is_file() else None


def lines_alone(contender: Contender, contenders: Sequence[Contender]) -> Contender | None:
    """Return the contender that is the same method with the same settings, but sees nothing; None if there is none."""
    for other in contenders:
        if not other.sees and type(other) is type(contender) and _method(other) == _method(contender):
            return other
    return None


def _method(contender: Contender) -> dict[str, Any]:
    """Parameters of a method apart from its name in tables and what it sees, and by which file a bound does."""
    apart = ("label", "sees", *(("checkpoint",) if isinstance(contender, LeaveOneOutContender) else ()))
    return {name: value for name, value in _parameters(contender).items() if name not in apart}


def _parameters(contender: Contender) -> dict[str, Any]:
    return asdict(contender)  # type: ignore[call-overload]


def as_recovery(answer: Any, lines: LineCloud, source: str, calibrated: bool | None = None) -> Recovery:
    """Convert a user's answer to a Recovery; bare points stay as they are, all with the same confidence."""
    points = answer.xyz if isinstance(answer, Recovery) else finite_rows("points", answer)
    if isinstance(answer, Recovery) and not answer.one_each:
        if answer.element.max() >= len(lines):
            raise InputError(f"got element {answer.element.max()} of {source}; expected rows of the {len(lines)} lines")
    elif len(points) != len(lines):
        raise InputError(f"got {len(points)} points of {source} for {len(lines)} lines; expected one a line, in order")
    if isinstance(answer, Recovery):
        return answer if calibrated is None else replace(answer, calibrated=calibrated)
    beta = np.sum((points - lines.origin) * lines.direction, axis=1)
    return Recovery(points, np.ones(len(points), dtype=np.float32), beta, calibrated=bool(calibrated))
