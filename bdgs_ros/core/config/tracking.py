"""Parameters of the tracking stage."""

from __future__ import annotations

from dataclasses import dataclass, field

from bdgs_ros.core.config.param import param


@dataclass(frozen=True)
class MotionConfig:
    """Prediction of the camera's motion on SE(3)."""

    model: str = param(
        'kalman',
        'none: the last pose; velocity: the motion between the last two poses goes on; '
        'kalman: constant-velocity filter',
        choices=('none', 'velocity', 'kalman'),
    )
    acceleration_sigma: float = param(
        3.0, 'white-noise acceleration, in a room', unit='m/s^2', low=0.0, high=100.0
    )
    angular_acceleration_sigma: float = param(
        10.0, 'white-noise angular acceleration', unit='rad/s^2', low=0.0, high=1000.0
    )
    gate_sigma: float = param(
        6.0, 'measurements further off reset the velocity', unit='sigma', low=1.0, high=100.0
    )
    coast_s: float = param(
        0.2, 'a velocity is believed no longer than this unseen', unit='s', low=0.0, high=10.0
    )


@dataclass(frozen=True)
class AlignConfig:
    """Direct RGB-D alignment, coarse to fine."""

    max_iterations: int = param(20, 'Gauss-Newton iterations over all levels', low=1, high=200)
    coarse_width: int = param(40, 'image width of the coarsest level', unit='px', low=20, high=640)
    fine_width: int = param(320, 'image width of the finest level', unit='px', low=20, high=1280)
    stop_px: float = param(
        0.05, 'a level ends when points at 1 m move less in a step', unit='px', low=1e-6, high=10.0
    )
    dof: float = param(
        5.0, 'degrees of freedom of the t-distribution: fewer reject more', low=1.0, high=100.0
    )
    intensity_noise: float = param(
        0.01, 'least scale of colour residuals', unit='grey level in [0, 1]', low=1e-4, high=1.0
    )
    pixel_noise: float = param(
        0.2, 'error of the warp, times the gradient', unit='px', low=0.0, high=10.0
    )
    depth_noise: float = param(
        0.0025, 'sigma_z = depth_noise * z^2, the Kinect model', unit='1/m', low=1e-5, high=1.0
    )
    depth_weight: float = param(
        0.5, 'of depth against colour, beyond their noise', low=0.0, high=100.0
    )
    pattern_sigma: float = param(
        0.2, 'bend of the depth image that is the sensor', unit='1/m', low=1e-6, high=10.0
    )
    correlated_pixels: float = param(
        5000.0, 'pixels that err together; scales the covariance', low=1.0, high=1e6
    )
    inlier_intensity: float = param(
        0.08, 'colour agrees within this', unit='grey level in [0, 1]', low=1e-3, high=1.0
    )
    inlier_depth_sigma: float = param(
        6.0, 'depth agrees within this', unit='sigma_z', low=0.1, high=1000.0
    )
    min_static: float = param(
        0.25, 'P(static) of both pixels together to count as compared', low=0.0, high=1.0
    )
    shade: float = param(
        0.03,
        'squares differ in brightness by this',
        unit='grey level in [0, 1]',
        low=1e-6,
        high=1.0,
    )
    max_points: int = param(
        20000, 'compared per level: about so many of more, in rows spread evenly', low=256
    )
    backend: str = param('auto', 'kernel', choices=('auto', 'native', 'numpy'))


@dataclass(frozen=True)
class KeyframeConfig:
    """When a frame becomes a keyframe."""

    translation: float = param(
        0.08, 'move from the last keyframe over median depth', low=0.0, high=10.0
    )
    rotation_deg: float = param(8.0, 'turn from the last keyframe', unit='deg', low=0.0, high=180)
    overlap: float = param(0.85, 'share of the reference still in view', low=0.0, high=1.0)
    max_interval: int = param(15, 'frames until a keyframe is forced', low=1, high=1000)


@dataclass(frozen=True)
class RefineConfig:
    """Alignment to the rendered static map, which is smoother than a camera's image."""

    enabled: bool = param(True, 'refine against the rendered static map')
    posterior: bool = param(True, "weigh residuals by the map's P(static), the feedback of 3.1")
    intensity_noise: float = param(
        0.03, 'least scale of colour residuals', unit='grey level in [0, 1]', low=1e-4, high=1.0
    )
    depth_weight: float = param(
        1.0, 'of depth against colour, beyond their noise', low=0.0, high=100.0
    )


@dataclass(frozen=True)
class MoversConfig:
    """What counts as standing before the static map, or as gone, whatever the detector says."""

    depth_sigma: float = param(
        8.0, 'nearer than the map, or farther, by this', unit='sigma_z', low=1.0, high=100.0
    )
    min_share: float = param(
        0.003, 'smaller things are noise', unit='share of the image', low=0.0, high=1.0
    )
    p_dynamic: float = param(0.8, 'probability given to such pixels', low=0.0, high=1.0)
    gone_share: float = param(
        0.3, 'so much of the map is seen through: not aligned to', low=0.0, high=1.0
    )
    reach: float = param(
        0.011, 'a mover comes no further in a frame', unit='share of the width', low=0.0, high=0.5
    )


@dataclass(frozen=True)
class PartsConfig:
    """Which part of the view is the world, where parts move in different ways."""

    enabled: bool = param(True, 'look for parts that move on their own')
    evidence: float = param(
        20.0, 'how many independent surfaces there are to agree with a motion', low=0.0
    )
    surprise: float = param(8.0, 'most that an unexpected motion counts against a part', low=0.0)
    margin: float = param(2.0, 'another part is so much more likely the world', low=0.0)
    moved: float = param(4.0, 'a square moves on its own: residuals beyond its noise', low=0.0)
    clearly: float = param(
        10.0, 'what moves on its own is a region whose mean is beyond this', low=0.0
    )
    unlike: float = param(
        9.0, 'nor is a square the world whose residuals are so many times its noise', low=0.0
    )
    surface: float = param(
        0.4, 'a plane or a thing moves as a whole if this share of it does', low=0.0, high=1.0
    )
    least: int = param(6, 'squares with depth; fewer tell nothing', low=1, high=1000)


@dataclass(frozen=True)
class CovarianceConfig:
    """
    How far off poses may be.

    Calibrated on what fourteen runs of two real and six synthetic recordings were off;
    docs/tracking.md says by how much.
    """

    spread: float = param(
        6.0, 'variance by which squares of an image disagree counts so often', low=0.0
    )
    open: float = param(
        0.03, 'variance that the images leave open, `correlated_pixels` with it', low=0.0
    )
    smear_s: float = param(
        0.003, 'what shifts in the image meanwhile, by blur and rows, is doubt', unit='s', low=0.0
    )


@dataclass(frozen=True)
class FeatureConfig:
    """ORB features, by which places are recognised and keyframes joined."""

    count: int = param(1000, 'features of an image at most', low=50, high=10000)
    scale: float = param(1.2, 'between levels of the pyramid', low=1.05, high=2.0)
    levels: int = param(8, 'of the pyramid', low=1, high=16)
    fast_threshold: int = param(12, 'weaker corners are none', unit='of 255', low=1, high=100)
    max_dynamic: float = param(0.5, 'likelier to move: no feature', low=0.0, high=1.0)
    max_distance: int = param(64, 'descriptors further apart differ', unit='bit', low=1, high=256)
    ratio: float = param(0.8, 'the best match over the second best', low=0.1, high=1.0)


@dataclass(frozen=True)
class LossConfig:
    """
    When a pose is not to be believed.

    Calibrated on two real and two synthetic recordings: frames that belong 1 to 60 frames away
    from where they were looked for. Of 583 good ones 1.4 % are called lost, of 1643 wrong ones
    0.4 % believed, all within 0.15 m; docs/tracking.md has more.
    """

    sigma_share: float = param(
        0.1, 'the images leave the position more open than this share of the depth: lost', low=0.0
    )
    sigma_rad: float = param(
        0.1, 'the images leave the direction more open than this: lost', unit='rad', low=0.0
    )
    inlier_ratio: float = param(
        0.2, 'fewer inliers among the compared pixels: lost', low=0.0, high=1.0
    )
    apart: float = param(
        0.05,
        'keyframe and map shift the view against each other by this: lost if neither fits',
        unit='rad',
        low=0.0,
    )
    fits: float = param(0.8, 'inliers of one that decides alone', low=0.0, high=1.0)
    coverage: float = param(
        0.04, 'smaller share of static pixels with depth: no keyframe', low=0.0, high=1.0
    )


@dataclass(frozen=True)
class PlacesConfig:
    """Keyframes by which a lost camera is found again."""

    count: int = param(150, 'places remembered; the most redundant go first', low=1, high=10000)
    width: int = param(320, 'of their images', unit='px', low=80, high=1280)
    features: int = param(500, 'of each', low=50, high=10000)
    candidates: int = param(3, 'likeliest places looked at in a frame', low=1, high=100)
    patience: int = param(
        1, 'lost frames at most that look at no place while newer frames wait', low=0, high=1000
    )
    min_inliers: int = param(15, 'matches that agree on a pose', low=4, high=1000)
    tolerance_px: float = param(
        2.0, 'a match agrees within this, in their images', unit='px', low=0.1, high=50.0
    )


@dataclass(frozen=True)
class PieceConfig:
    """What a lost camera does: it makes a piece of map of its own until it is found again."""

    enabled: bool = param(True, 'follow a lost camera in a piece of map of its own')
    patience_s: float = param(
        1.0, 'lost for so long before a piece begins', unit='s', low=0.0, high=3600.0
    )
    keyframes: int = param(60, 'of a piece that are kept for the map', low=1, high=1000)
    young_s: float = param(
        5.0, 'a world seen for longer is never given up', unit='s', low=0.0, high=3600.0
    )
    least_s: float = param(
        0.5, 'a world seen for less is given up for a piece seen for longer', unit='s', low=0.0
    )
    still: float = param(0.5, 'so is a young one of whose view less was still', low=0.0, high=1.0)


@dataclass(frozen=True)
class RegistrationConfig:
    """When colour and depth are apart, in time or by pixels; measured on edges of both."""

    enabled: bool = param(True, 'measure whether depth belongs to colour, and warn')
    window_s: float = param(5.0, 'measured by so much', unit='s', low=1.0, high=60.0)
    frames: int = param(150, 'or by so many frames', low=30, high=1000)
    least_frames: int = param(20, 'fewer tell nothing', low=20, high=1000)
    pause_s: float = param(
        60.0, 'between measurements once one was clear', unit='s', low=0.0, high=3600.0
    )
    steps: int = param(4, 'of the measurement in each frame, about a millisecond each', low=1)
    lag_s: float = param(
        0.02, 'less is not called late, beyond three sigma', unit='s', low=0.0, high=10.0
    )
    scale: float = param(0.03, 'nor is less called another scale', low=0.0, high=1.0)
    shift: float = param(0.0125, 'or another place', unit='share of the width', low=0.0, high=1.0)


@dataclass(frozen=True)
class TrackingConfig:
    """The camera pose of every frame."""

    masked: bool = param(True, 'weigh residuals by P(static)')
    readout_s: float = param(
        0.0,
        'from first row to last of a rolling shutter, until the back end has measured it',
        unit='s',
        low=-0.1,
        high=0.1,
    )
    motion: MotionConfig = field(default_factory=MotionConfig)
    align: AlignConfig = field(default_factory=AlignConfig)
    refine: RefineConfig = field(default_factory=RefineConfig)
    keyframe: KeyframeConfig = field(default_factory=KeyframeConfig)
    movers: MoversConfig = field(default_factory=MoversConfig)
    parts: PartsConfig = field(default_factory=PartsConfig)
    covariance: CovarianceConfig = field(default_factory=CovarianceConfig)
    features: FeatureConfig = field(default_factory=FeatureConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    places: PlacesConfig = field(default_factory=PlacesConfig)
    piece: PieceConfig = field(default_factory=PieceConfig)
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
