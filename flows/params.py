"""All parameters of the DAG, grouped as the DAG is. The defaults are the preset "default"."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from ss_flow.tasks.capture.colours import ColourParams
from ss_flow.tasks.capture.completion import CompletionParams
from ss_flow.tasks.capture.depth import AgreementParams, SweepParams
from ss_flow.tasks.capture.given_scene import GivenSceneParams
from ss_flow.tasks.capture.ingest import IngestParams
from ss_flow.tasks.capture.misfits import CheckParams
from ss_flow.tasks.capture.mono import MonoParams
from ss_flow.tasks.capture.neighbors import NeighborParams
from ss_flow.tasks.capture.planes import PlaneParams
from ss_flow.tasks.capture.pose_fit import PoseFitParams
from ss_flow.tasks.capture.refine_poses import RefinePosesParams
from ss_flow.tasks.capture.registration import RegistrationParams
from ss_flow.tasks.capture.sfm import SfmParams
from ss_flow.tasks.capture.stereo import StereoParams
from ss_flow.tasks.capture.transients import TransientParams
from ss_flow.tasks.capture.video import VideoParams
from ss_flow.tasks.geometry.visibility import VisibilityParams
from ss_flow.tasks.ranges import Count, Fraction, Natural, NonNegative, QuarterTurns
from ss_flow.tasks.semantics.dense_describe import DenseDescribeParams
from ss_flow.tasks.semantics.describe import DescribeParams
from ss_flow.tasks.semantics.query import QueryParams
from ss_flow.tasks.splat.label import LabelParams
from ss_flow.tasks.splat.merge import MergeParams
from ss_flow.tasks.splat.plan import PlanParams
from ss_flow.tasks.splat.reconstruct import ReconstructParams
from ss_flow.tasks.splat.refine import RefineParams
from ss_flow.tasks.splat.render_masks import RenderMasksParams
from ss_flow.tasks.splat.resolve import ResolveParams
from ss_flow.tasks.split.agreement import ONE_THING
from ss_flow.tasks.split.boards import BoardParams
from ss_flow.tasks.split.close_ups import CloseUpParams
from ss_flow.tasks.split.dense import DenseParams
from ss_flow.tasks.split.dense_splatting import DenseSplattingParams
from ss_flow.tasks.split.hierarchy import HierarchyParams
from ss_flow.tasks.split.observe import ObserveParams
from ss_flow.tasks.split.overlooked import OverlookedParams
from ss_flow.tasks.split.parts import PartsParams
from ss_flow.tasks.split.propagate import PropagateParams
from ss_flow.tasks.split.reproject import ReprojectParams
from ss_flow.tasks.split.reprompt import RepromptParams
from ss_flow.tasks.split.segment import SegmentParams
from ss_flow.tasks.split.segment_rgbd import SegmentRgbdParams
from ss_flow.tasks.split.walls import WallParams


@dataclass(frozen=True)
class CaptureParams:
    """Photos, poses, depth."""

    stride: Count = 1
    """Take every n-th view, where views that are left out count too (ScanNet is evaluated at 20); of a video, one n-th
    of the frames."""
    max_views: Natural = 300
    """The most views of a capture that brings poses. Of more, those are taken from which all others are no farther than
    `capture.video.motion`, by their poses; 0 = all are used."""
    depth: Literal["auto", "sensor", "mvs", "mono", "rendered"] = "auto"
    """Where depth comes from; "auto" is the sensor where there is one, else the scene of --scene where one is given
    ("rendered"), else several views (mvs)."""
    calibrate: Literal["auto", "none", "depth"] = "auto"
    """"depth" scales and shifts the sensor's depth so that its edges fit the photos, where that is found to be better;
    "auto" where it is clearly better. Both multiply it by the factor by which it clearly fits the poses."""
    refine_poses: Literal["auto", "always", "never"] = "auto"
    """Whether poses that come with the capture are first refined by bundle adjustment; "auto" does so where photos do
    not fit the given ones, and uses what it finds where photos then fit better and measured depth no worse; where
    another lens makes them fit, it takes that instead."""
    turns: QuarterTurns | None = None
    """Quarter turns, counterclockwise, by which the segmenter and the encoder see the photos turned, since they know
    things as they stand, and the report shows them; none = photos that lie on their side by the given poses stand
    upright. Masks stay as the photos are."""
    monodepth: str = "auto"
    """The network for depth=mono: a name of the catalogue, or "auto"."""
    ingest: IngestParams = field(default_factory=IngestParams)
    video: VideoParams = field(default_factory=VideoParams)
    sfm: SfmParams = field(default_factory=SfmParams)
    pose_fit: PoseFitParams = field(default_factory=PoseFitParams)
    refine: RefinePosesParams = field(default_factory=RefinePosesParams)
    neighbors: NeighborParams = field(default_factory=NeighborParams)
    sweep: SweepParams = field(default_factory=SweepParams)
    agreement: AgreementParams = field(default_factory=AgreementParams)
    stereo: StereoParams = field(default_factory=StereoParams)
    planes: PlaneParams = field(default_factory=PlaneParams)
    """What Split takes to be flat where comparing views tells nothing. Nothing is trained on it."""
    registration: RegistrationParams = field(default_factory=RegistrationParams)
    transients: TransientParams = field(default_factory=TransientParams)
    completion: CompletionParams = field(default_factory=CompletionParams)
    mono: MonoParams = field(default_factory=MonoParams)
    given: GivenSceneParams = field(default_factory=GivenSceneParams)
    colours: ColourParams = field(default_factory=ColourParams)
    checks: CheckParams = field(default_factory=CheckParams)


@dataclass(frozen=True)
class SplitParams:
    """Masks -> view-consistent instances."""

    segmenter: str = "auto"
    """The network that makes the masks: a name of the catalogue, "auto", or "none" for colour, depth and normals."""
    noise: NonNegative = 0.65
    """Standard deviation of a photo's noise from pixel to pixel, of 255 grey values, above which the segmenter sees it
    smoothed; 0 = never."""
    segment: SegmentParams = field(default_factory=SegmentParams)
    close_ups: CloseUpParams = field(default_factory=CloseUpParams)
    rgbd: SegmentRgbdParams = field(default_factory=SegmentRgbdParams)
    dense_source: Literal["depth", "splatting"] = "depth"
    """Where the dense points come from: all depth maps, or a short splatting of the whole scene, as in the paper."""
    dense: DenseParams = field(default_factory=DenseParams)
    splatting: DenseSplattingParams = field(default_factory=DenseSplattingParams)
    visibility: VisibilityParams = field(default_factory=VisibilityParams)
    visible_color: NonNegative = 8.0
    """Where a view has no depth, it sees the points in front whose colour its photo shows: this is how far they may be
    apart, in CIELAB. 0 = it sees none there, and so where a sensor's gaps are closed (`capture.completion`)."""
    observe: ObserveParams = field(default_factory=ObserveParams)
    propagate: PropagateParams = field(default_factory=PropagateParams)
    overlooked: OverlookedParams = field(default_factory=OverlookedParams)
    parts: PartsParams = field(default_factory=PartsParams)
    hierarchy: HierarchyParams = field(default_factory=HierarchyParams)
    granularity: Fraction = ONE_THING
    """How far pieces are put together: those that more than this share of the views show as one thing are one instance.
    1 leaves every part on its own, 0.3 gives groups of things."""
    boards: BoardParams = field(default_factory=BoardParams)
    walls: WallParams = field(default_factory=WallParams)
    reprompt: RepromptParams = field(default_factory=RepromptParams)
    reproject: ReprojectParams = field(default_factory=ReprojectParams)


@dataclass(frozen=True)
class SplatParams:
    """Instances -> Gaussians -> one scene."""

    reconstruct: ReconstructParams = field(default_factory=ReconstructParams)
    refine: RefineParams = field(default_factory=RefineParams)
    resolve: ResolveParams = field(default_factory=ResolveParams)
    plan: PlanParams = field(default_factory=PlanParams)
    merge: MergeParams = field(default_factory=MergeParams)
    masks: RenderMasksParams = field(default_factory=RenderMasksParams)
    label: LabelParams = field(default_factory=LabelParams)


@dataclass(frozen=True)
class SemanticsParams:
    """Gaussians -> descriptors -> text."""

    encoder: str = "auto"
    """The network that compares texts and pictures: a name of the catalogue, "auto", or "none" for colour words. With
    "imagenet-class-names" (the extra `names`), pictures are mixtures of ImageNet's class names."""
    masks: Literal["refined", "rendered"] = "refined"
    """What the encoder is shown of an instance: its "refined" masks, or the masks "rendered" from its Gaussians (M^gs),
    as in the paper."""
    describe: DescribeParams = field(default_factory=DescribeParams)
    patches: str = "none"
    """The network that gives every Gaussian of an object a vector: a name of the catalogue, "auto" (DINOv2 where it is
    here, else a segmenter), or "none" for no such vectors."""
    dense: DenseDescribeParams = field(default_factory=DenseDescribeParams)
    query: QueryParams = field(default_factory=QueryParams)


@dataclass(frozen=True)
class EvaluateParams:
    """Measuring against ground truth, where there is some."""

    zero_is_void: bool | None = None
    """Whether 0 in the ground truth means "not annotated" and does not count, or is background; none = it does not
    count unless the capture's `instances.json` names 0, as that of a generated room does."""
    lpips: str = "auto"
    """The network of LPIPS, for renderings of views that were kept back: a name of the catalogue, "auto", or "none" for
    no LPIPS."""


@dataclass(frozen=True)
class Params:
    """Every parameter there is."""

    capture: CaptureParams = field(default_factory=CaptureParams)
    split: SplitParams = field(default_factory=SplitParams)
    splat: SplatParams = field(default_factory=SplatParams)
    semantics: SemanticsParams = field(default_factory=SemanticsParams)
    evaluate: EvaluateParams = field(default_factory=EvaluateParams)
