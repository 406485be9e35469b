"""Every default of the system, typed, frozen and nested by stage.

The command line, the ROS node and the tests all read this file; nothing else holds a default.
"""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from igaussian_core.errors import ConfigError


def _option(
    default: Any,
    help: str,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
) -> Any:
    """A field with its description and its allowed range or choices."""
    return field(
        default=default, metadata={"help": help, "low": low, "high": high, "choices": choices}
    )


@dataclass(frozen=True)
class ImageConfig:
    """What is done to a frame before anything looks at it."""

    max_side: int = _option(640, "longer image side in pixels after shrinking", 64, 4096)
    min_contrast: float = _option(
        4.0, "standard deviation of grey levels below which a frame is too dark or flat", 0, 127
    )


@dataclass(frozen=True)
class FeatureConfig:
    """Keypoints and matcher of both stages; a compiled map holds those it was made with."""

    matcher: str = _option(
        "xfeat",
        "xfeat (XFeat + LighterGlue) or sift; sift is taken where the weights are missing",
        choices=("xfeat", "sift"),
    )
    keypoints: int = _option(1024, "keypoints a frame", 64, 8192)


@dataclass(frozen=True)
class CoarseConfig:
    """Stage one: landmarks compiled from the map, the pose network trained on it, or both."""

    method: str = _option(
        "cascade",
        "network: the paper's, trained on the map; landmarks: keypoints of the map's source "
        "views; cascade: the network is asked first where the map has one, then the landmarks",
        choices=("network", "landmarks", "cascade"),
    )

    rank_keypoints: int = _option(256, "query keypoints that rank the source views", 32, 4096)
    rank_landmarks: int = _option(192, "landmarks of each source view used in ranking", 32, 4096)
    top_views: int = _option(8, "source views matched in full", 1, 64)
    max_reprojection_px: float = _option(8.0, "inlier threshold of landmark PnP in pixels", 0.5, 64)
    min_inliers: int = _option(12, "least inliers of a hypothesis", 4, 1000)
    hypotheses: int = _option(3, "hypotheses handed to stage two", 1, 16)
    rival_share: float = _option(
        0.5, "share of a place's inliers with which another one is its rival: it is refined too, "
        "and neither is accepted where both convince alike; 2: no rivals", 0, 2
    )  # fmt: skip
    network_head: str = _option(
        "memory",
        "memory: regression among thousands of views of known pose; attention: candidates and "
        "weights of the paper's source views; either where the map's network has no other",
        choices=("memory", "attention"),
    )
    network_hypotheses: int = _option(
        4, "hypotheses of the pose network handed to stage two", 1, 16
    )
    network_renders: int = _option(
        1, "renders by which the first hypothesis of method=network is corrected: what the network "
        "says of them shows by how much it errs there; 0: the paper's single pass", 0, 4
    )  # fmt: skip


@dataclass(frozen=True)
class RefineConfig:
    """Stage two: match the image with a render at the hypothesis, PnP with rendered depth."""

    matcher: str = _option(
        "auto",
        "what matches image and render where following points does not convince; auto: the "
        "keypoints that the map was compiled with",
        choices=("auto", "xfeat", "xfeat_semi_dense", "loftr", "sift"),
    )
    loftr_weights: str = _option("", "checkpoint file of LoFTR, see docs/matchers.md")
    guided_radius_px: float = _option(
        40.0, "radius around the prior's place within which keypoints are matched when "
        "tracking; 0: they are matched as from nothing", 0, 1000
    )  # fmt: skip
    solver: str = _option(
        "pnp",
        "pnp: 2D-3D with the rendered depth; paper: essential matrix, its scale from elsewhere",
        choices=("pnp", "paper"),
    )
    scale: str = _option(
        "depth",
        "where solver=paper takes the translation's length from; depth: the median ratio of "
        "rendered and triangulated depth; vit: the paper's, a network that sees both images",
        choices=("depth", "vit"),
    )
    max_sampson_px: float = _option(
        1.0, "inlier threshold of the essential matrix, Sampson error in pixels", 0.1, 32
    )
    approach_side: int = _option(
        160, "longer side in pixels of the small images on which a hypothesis is brought near",
        32, 8192,
    )  # fmt: skip
    align_points: int = _option(
        400, "points of a render that are followed into the image", 16, 4096
    )
    align_window: int = _option(15, "side in pixels of the patches that are followed", 5, 51)
    align_levels: int = _option(
        2, "pyramid levels of following: 2 finds points about 15 pixels off", 0, 5
    )
    align_rounds: int = _option(3, "most renders one alignment gets", 1, 8)
    rounds: int = _option(2, "most renders matched by descriptors", 1, 8)
    converged_px: float = _option(
        4.0, "image motion in pixels below which a tracked frame gets no new render; others: half",
        0.01, 16,
    )
    moved_px: float = _option(
        25.0, "image motion of a step above which descriptors are matched again", 1, 500
    )
    max_reprojection_px: float = _option(3.0, "inlier threshold of PnP in pixels", 0.25, 32)
    min_alpha: float = _option(0.8, "least alpha of a render's pixel that is lifted to 3D", 0, 1)
    max_depth_step: float = _option(
        0.1, "relative depth change within 2 px above which a pixel is an edge", 0, 1
    )
    photometric: str = _option(
        "polish",
        "polish: an aligned pose is moved to where brightness agrees as well; off: it is not",
        choices=("off", "polish"),
    )
    photometric_pixels: int = _option(6000, "most pixels that are polished with", 200, 100000)
    covariance_cell_px: float = _option(
        32.0, "side of the image cells over which errors are summed for the covariance, "
        "since neighbours share the map's errors; 0: each match by itself", 0, 1000
    )  # fmt: skip
    covariance_inflation: float = _option(
        8.0, "variance factor, since the map's errors reach over cells", 1, 1000,
    )  # fmt: skip


@dataclass(frozen=True)
class VerifyConfig:
    """What a pose must show to be accepted; fixed from held-out photos, see docs/accuracy.md."""

    min_inliers_align: int = _option(40, "least PnP inliers of followed points", 4, 1000)
    min_ratio_align: float = _option(0.3, "least share of followed points that agree", 0, 1)
    min_inliers_xfeat: int = _option(40, "least PnP inliers with XFeat + LighterGlue", 4, 1000)
    min_ratio_xfeat: float = _option(0.35, "least inlier ratio with XFeat + LighterGlue", 0, 1)
    min_inliers_sift: int = _option(25, "least PnP inliers with SIFT", 4, 1000)
    min_ratio_sift: float = _option(0.25, "least inlier ratio with SIFT", 0, 1)
    max_residual_px: float = _option(1.25, "largest median reprojection error of inliers", 0.1, 16)
    min_coverage: float = _option(
        0.05, "least share of the render's pixels that the map covers (alpha)", 0, 1
    )
    min_spread: float = _option(
        0.05, "least share of the image's area that the inliers' spread covers", 0, 1
    )
    max_sigma_deg: float = _option(
        1.0, "largest standard deviation of the pose's rotation, in degrees", 0.01, 90
    )
    min_agreement: float = _option(
        0.81, "least mean correlation of image and render in cells around the inliers; -1: any",
        -1, 1,
    )  # fmt: skip
    min_sharpness: float = _option(
        0.2, "least share of the render's fine detail that the image shows; -10: any", -10, 1
    )
    max_prior_shift: float = _option(
        0.5, "image widths that a pose may lie from the prior's view; beyond, half as many "
        "inliers again and a quarter more of their share are wanted", 0, 1000,
    )  # fmt: skip


@dataclass(frozen=True)
class TrackingConfig:
    """How the last accepted pose serves as the next frame's prior."""

    enabled: bool = _option(True, "use the last pose, with odometry where there is some, as prior")
    max_gap_s: float = _option(2.0, "age above which the last pose is no prior any more", 0, 60)


@dataclass(frozen=True)
class RuntimeConfig:
    """The machine."""

    threads: int = _option(2, "threads of networks and renderer", 1, 256)
    budget_ms: float = _option(
        1000.0, "milliseconds of a frame after which no further hypothesis is tried; a frame with "
        "a prior matches descriptors elsewhere only within half of them", 1, 60000
    )  # fmt: skip
    max_image_age_s: float = _option(
        1.0, "frames older than this when work starts are dropped", 0, 60
    )


@dataclass(frozen=True)
class Config:
    """The whole configuration, one group a stage."""

    image: ImageConfig = field(default_factory=ImageConfig)
    features: FeatureConfig = field(default_factory=FeatureConfig)
    coarse: CoarseConfig = field(default_factory=CoarseConfig)
    refine: RefineConfig = field(default_factory=RefineConfig)
    verify: VerifyConfig = field(default_factory=VerifyConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    runtime: RuntimeConfig = field(default_factory=RuntimeConfig)

    @staticmethod
    def from_flat(values: Mapping[str, Any]) -> Config:
        """Config from dotted names, e.g. {"refine.rounds": 2}; the rest stays at its default.

        Raises:
            ConfigError: an unknown name, a wrong type, a value out of range.
        """
        known = options()
        groups: dict[str, dict[str, Any]] = {}
        for name, value in values.items():
            if name not in known:
                raise ConfigError(f"config: unknown key '{name}'; known: {', '.join(known)}")
            group, key = name.split(".")
            groups.setdefault(group, {})[key] = _checked(name, value, known[name])
        parts = {
            name: group(**groups.get(name, {}))
            for name, group in typing.get_type_hints(Config).items()
        }
        return Config(**parts)

    @staticmethod
    def from_file(path: str | Path) -> Config:
        """Config from a JSON file, nested by group as `to_json` writes it.

        Raises:
            ConfigError: unreadable, no JSON object, or as in `from_flat`.
        """
        try:
            data = json.loads(Path(path).read_text())
        except (OSError, ValueError) as error:
            raise ConfigError(f"{path}: no configuration: {error}") from error
        if not isinstance(data, dict) or not all(isinstance(v, dict) for v in data.values()):
            raise ConfigError(f"{path}: expected an object of groups, e.g. {{'refine': {{...}}}}")
        flat = {f"{g}.{k}": v for g, part in data.items() for k, v in part.items()}
        return Config.from_flat(flat)

    def to_flat(self) -> dict[str, Any]:
        """Dotted names to values, in the order of this file."""
        return {
            f"{group}.{key}": value
            for group, part in dataclasses.asdict(self).items()
            for key, value in part.items()
        }

    def to_json(self) -> str:
        """Nested by group; what is written beside results."""
        return json.dumps(dataclasses.asdict(self), indent=1)


@dataclass(frozen=True)
class Option:
    """Description of one configuration value, for the node's parameters and the docs."""

    type: type
    default: Any
    help: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]


def options() -> dict[str, Option]:
    """Every option by its dotted name."""
    result: dict[str, Option] = {}
    for group_name, group_type in typing.get_type_hints(Config).items():
        hints = typing.get_type_hints(group_type)
        for f in dataclasses.fields(group_type):
            m: types.MappingProxyType[Any, Any] = f.metadata
            result[f"{group_name}.{f.name}"] = Option(
                hints[f.name], f.default, m["help"], m["low"], m["high"], m["choices"]
            )
    return result


def _checked(name: str, value: Any, option: Option) -> Any:
    """The value in its own type, or ConfigError."""
    if option.type is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not option.type:
        raise ConfigError(
            f"config: {name} must be {option.type.__name__}, got {type(value).__name__} {value!r}"
        )
    if option.choices and value not in option.choices:
        raise ConfigError(f"config: {name}='{value}' is none of {', '.join(option.choices)}")
    if option.low is not None and option.high is not None and (
        not option.low <= float(typing.cast(float, value)) <= option.high
    ):
        raise ConfigError(f"config: {name}={value} is outside [{option.low}, {option.high}]")
    return value
