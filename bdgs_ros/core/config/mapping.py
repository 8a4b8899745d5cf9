"""Parameters of the Gaussian map."""

from __future__ import annotations

from dataclasses import dataclass, field

from bdgs_ros.core.config.param import param


@dataclass(frozen=True)
class LossConfig:
    """The weights of Eq. 7 and 9, and the depth term that the paper lacks."""

    psim: float = param(0.85, 'lambda_psim of Eq. 7', low=0.0)
    dynamic: float = param(0.15, 'lambda_dyn of Eq. 7', low=0.0)
    reg: float = param(1.0, 'lambda_reg of Eq. 7 on the squared norm of Sigma', low=0.0)
    ssim: float = param(0.2, 'gamma of Eq. 9', low=0.0, high=1.0)
    smooth: float = param(
        0.01, 'lambda of the first term of Eq. 8, edge-aware', unit='1/m', low=0.0
    )
    depth: float = param(0.3, 'weight of the depth term', unit='1/m', low=0.0)
    empty: float = param(
        0.02, 'weight of what shines through where a surface was measured', low=0.0
    )


@dataclass(frozen=True)
class LearningRateConfig:
    """Adam step sizes."""

    means: float = param(0.002, 'positions', unit='m', low=0.0)
    scales: float = param(0.005, 'log scales', low=0.0)
    quats: float = param(0.002, 'rotations', low=0.0)
    opacities: float = param(0.05, 'logit opacities', low=0.0)
    colors: float = param(0.005, 'colours', low=0.0)
    harmonics: float = param(0.00025, 'view-dependent part of colours', low=0.0)
    exposure: float = param(0.002, 'log gain and offset of a keyframe', low=0.0)
    pose: float = param(0.001, 'pose of a keyframe', unit='m and rad', low=0.0)


@dataclass(frozen=True)
class InsertConfig:
    """Where new Gaussians come from."""

    silhouette: float = param(0.6, 'the map is empty below', low=0.0, high=1.0)
    depth_sigma: float = param(5.0, 'nearer than the map beyond this', unit='sigma_z', low=0.5)
    finest: int = param(
        1,
        'pixels of the mapping image per Gaussian and axis where there is detail',
        low=1,
        high=16,
    )
    doublings: int = param(3, 'times that it doubles where there is none', low=0, high=6)
    detail: float = param(
        0.025, 'cells that lose more of the image (RMS of colour in [0, 1]) are split', low=0.0
    )
    sigma_px: float = param(
        0.85, 'standard deviation of a new Gaussian over its cell', low=0.1, high=5.0
    )
    flatness: float = param(
        0.2, 'thickness of a new Gaussian over its width; 1 makes them round', low=0.01, high=1.0
    )
    max_slant: float = param(
        5.0, 'greatest length over width of a new Gaussian on a slanted surface', low=1.0
    )
    normal_px: int = param(
        4, 'radius of the largest window in which planes are fitted', unit='px', low=1, high=32
    )
    opacity: float = param(0.7, 'opacity of a new Gaussian', low=0.01, high=0.99)
    min_depth: float = param(0.15, 'nearer depths are not used', unit='m', low=0.0)
    max_depth: float = param(30.0, 'farther depths are not used', unit='m', low=0.1)
    edge: float = param(
        0.04, 'depth steps to a neighbour above this share of z are edges', low=0.0, high=1.0
    )
    margin_px: int = param(
        3, 'pixels around a mover where nothing is inserted', unit='px', low=0, high=50
    )


@dataclass(frozen=True)
class PruneConfig:
    """What is taken out of the map."""

    opacity: float = param(0.05, 'fainter Gaussians go', low=0.0, high=1.0)
    scale: float = param(0.4, 'larger Gaussians go', unit='m', low=0.001)
    axis_ratio: float = param(
        36.0, 'Gaussians longer than so many times their second axis go', low=1.0
    )
    contribution: float = param(
        0.03, 'Gaussians whose weight in views of their surface is less go', low=0.0, high=1.0
    )
    fading: float = param(
        0.3, 'share of a larger weight seen before that still counts', low=0.0, high=1.0
    )
    trial: int = param(5, 'keyframes for which a Gaussian is new', low=0)
    trial_checks: int = param(2, 'keyframes that must have looked at a new Gaussian', low=1)
    trial_share: float = param(
        0.5, 'share of them that must have seen it, or it goes', low=0.0, high=1.0
    )
    max_gaussians: int = param(80000, 'budget', low=100)


@dataclass(frozen=True)
class MergeConfig:
    """How neighbours become one when the map has more Gaussians than `prune.max_gaussians`."""

    share: float = param(0.9, 'of the budget that is left after merging', low=0.1, high=1.0)
    reach: float = param(
        0.5, 'cells of the first round over the size of Gaussians; doubled twice', low=0.01
    )
    color: float = param(0.05, 'greatest difference of colour from the heavier neighbour', low=0.0)


@dataclass(frozen=True)
class DensifyConfig:
    """Division of Gaussians by gradient, in refinement."""

    rounds: int = param(5, 'times in the first half of a refinement; 0: never', low=0, high=100)
    share: float = param(0.1, 'of the Gaussians divided each time', low=0.0, high=1.0)


@dataclass(frozen=True)
class PyramidConfig:
    """Coarse to fine, Eq. 12 and 13."""

    levels: int = param(3, 'levels of the Gaussian pyramid', low=1, high=5)
    coarse_share: float = param(
        0.2, 'share of the iterations on the levels above the finest', low=0.0, high=1.0
    )
    opacity_threshold: float = param(
        0.005, 'tau_0 of Eq. 13; doubles with each level', low=0.0, high=0.5
    )


@dataclass(frozen=True)
class ModelConfig:
    """The view of the map that tracking gets."""

    silhouette: float = param(0.8, 'below, the map counts as empty', low=0.0, high=1.0)


@dataclass(frozen=True)
class ColorConfig:
    """View-dependent colour."""

    degree: int = param(0, 'of spherical harmonics; 0: the same from everywhere', low=0, high=3)


@dataclass(frozen=True)
class MappingConfig:
    """The Gaussian map and its optimisation."""

    enabled: bool = param(True, 'without it tracking is keyframe odometry (Table 6)')
    width: int = param(640, 'image width at which the map is optimised', unit='px', low=40)
    growth_width: int = param(
        320,
        'image width at which beliefs are updated, Gaussians added, tracking answered',
        unit='px',
        low=40,
    )
    step_pixels: int = param(
        153600, 'of a larger image, one step sees a window of this many', unit='px', low=400
    )
    iterations: int = param(40, 'optimisation steps per keyframe', low=0, high=1000)
    enough: float = param(
        0.15, 'with less gain at the last coarse level only min_fine iterations follow', high=1.0
    )
    min_fine: int = param(
        16, 'iterations at the finest level where the residual says enough', low=0, high=1000
    )
    hurried: int = param(
        4, 'iterations while the next keyframe waits (realtime)', low=0, high=1000
    )
    settle: int = param(
        0, 'steps on all keyframes after those of each keyframe', low=0, high=10000
    )
    settle_rate: float = param(0.4, 'share of the learning rates in these', low=0.0, high=1.0)
    spare: int = param(
        20,
        'more iterations per keyframe for each processor beyond two, while none waits (realtime)',
        low=0,
        high=10000,
    )
    window: int = param(8, 'newest keyframes in every optimisation', low=1, high=64)
    keyframes: int = param(
        64, 'keyframes whose images are kept; of others only the Gaussians', low=2, high=100000
    )
    threads: int = param(
        2, 'of the rasteriser; in real time one processor is left to tracking', low=1, high=64
    )
    backend: str = param(
        'auto', 'rasteriser, and where the map lives', choices=('auto', 'cuda', 'native', 'torch')
    )
    seed: int = param(0, 'of the choice of keyframes', low=0)
    loss: LossConfig = field(default_factory=LossConfig)
    rate: LearningRateConfig = field(default_factory=LearningRateConfig)
    insert: InsertConfig = field(default_factory=InsertConfig)
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    prune: PruneConfig = field(default_factory=PruneConfig)
    merge: MergeConfig = field(default_factory=MergeConfig)
    pyramid: PyramidConfig = field(default_factory=PyramidConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    color: ColorConfig = field(default_factory=ColorConfig)
