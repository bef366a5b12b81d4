"""Jobs of the COLMAP process: `sfm` writes them as JSON, `sfm_worker` reads them."""

from __future__ import annotations

from typing import Literal, NotRequired, TypedDict


class FeatureJob(TypedDict):
    """Extract features."""

    task: Literal["features"]
    database: str
    photos: str  # folder
    names: list[str]
    camera: str
    groups: list[list[str]]  # names that share a camera, where the camera is "per-device"
    masks: str | None  # folder
    max_features: int
    max_side: int  # px
    sift: str  # whose: "opencv" or "colmap"
    seed: int
    jobs: int
    parent: NotRequired[int]  # process id, added when the job is written


class MatchJob(TypedDict):
    """Match and verify pairs."""

    task: Literal["matches"]
    database: str
    names: list[str]
    test_names: list[str]
    matcher: str
    similar: int
    neighbours: int
    only: list[str] | None  # names that look for partners; None: all
    focals: dict[str, float] | None  # name -> over the longer side, by EXIF; None: poses are known
    earlier: str | None  # file of pairs that the database holds matched
    seed: int
    jobs: int
    parent: NotRequired[int]


class MappingJob(TypedDict):
    """Build models."""

    task: Literal["mapping"]
    database: str
    motions: str  # file of the stage before
    photos: str  # folder
    output: str  # folder
    progress: str  # file that holds the number of placed photos
    mapper: str
    growth: float
    refinements: int
    local_refinements: int
    local_cameras: int
    seed: int
    jobs: int
    parent: NotRequired[int]


class TriangulationJob(TypedDict):
    """Triangulate points with known poses."""

    task: Literal["triangulation"]
    database: str
    photos: str  # folder
    model: str  # folder; cameras and poses, numbered as in the database
    output: str  # folder
    seed: int
    parent: NotRequired[int]


class MotionJob(TypedDict):
    """Find the motions of matched pairs whose cameras are known."""

    task: Literal["motions"]
    database: str
    model: str  # folder; cameras, numbered as in the database
    output: str  # file
    seed: int
    jobs: int
    parent: NotRequired[int]


SfmJob = FeatureJob | MatchJob | MappingJob | TriangulationJob | MotionJob
