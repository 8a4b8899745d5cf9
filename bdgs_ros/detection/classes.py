"""
Which COCO classes move, and how surely: the dynamic prior per class of section 3.2.

The paper gives each detection a prior that its class is dynamic and leaves the table open. Ours
has four tiers, for the question "does it move while the robot looks at it": what moves by itself
(animals below people: small networks take toys and shadows for dogs);
what moves with somebody; what is carried or pushed now and then; all else is furniture (0).
A low prior never makes a mask on its own (it stays under one half); it only tips the balance when
geometry agrees, which is why a chair may have one.
"""

from __future__ import annotations

# fmt: off
COCO_NAMES: tuple[str, ...] = (
    'person', 'bicycle', 'car', 'motorcycle', 'airplane', 'bus', 'train', 'truck', 'boat',
    'traffic light', 'fire hydrant', 'stop sign', 'parking meter', 'bench', 'bird', 'cat', 'dog',
    'horse', 'sheep', 'cow', 'elephant', 'bear', 'zebra', 'giraffe', 'backpack', 'umbrella',
    'handbag', 'tie', 'suitcase', 'frisbee', 'skis', 'snowboard', 'sports ball', 'kite',
    'baseball bat', 'baseball glove', 'skateboard', 'surfboard', 'tennis racket', 'bottle',
    'wine glass', 'cup', 'fork', 'knife', 'spoon', 'bowl', 'banana', 'apple', 'sandwich',
    'orange', 'broccoli', 'carrot', 'hot dog', 'pizza', 'donut', 'cake', 'chair', 'couch',
    'potted plant', 'bed', 'dining table', 'toilet', 'tv', 'laptop', 'mouse', 'remote',
    'keyboard', 'cell phone', 'microwave', 'oven', 'toaster', 'sink', 'refrigerator', 'book',
    'clock', 'vase', 'scissors', 'teddy bear', 'hair drier', 'toothbrush',
)

_MOVES_BY_ITSELF = {
    'person': 0.95, 'cat': 0.8, 'dog': 0.8, 'bird': 0.8, 'horse': 0.8, 'sheep': 0.8,
    'cow': 0.8, 'elephant': 0.8, 'bear': 0.8, 'zebra': 0.8, 'giraffe': 0.8,
}
_MOVES_WITH_SOMEBODY = {
    'bicycle': 0.7, 'car': 0.7, 'motorcycle': 0.7, 'airplane': 0.7, 'bus': 0.8, 'train': 0.8,
    'truck': 0.7, 'boat': 0.7, 'sports ball': 0.7, 'frisbee': 0.8, 'kite': 0.8,
    'skateboard': 0.7, 'skis': 0.7, 'snowboard': 0.7, 'surfboard': 0.7, 'tie': 0.9,
}
_IS_CARRIED = {
    'backpack': 0.4, 'handbag': 0.4, 'suitcase': 0.4, 'umbrella': 0.4, 'baseball bat': 0.4,
    'baseball glove': 0.4, 'tennis racket': 0.4, 'teddy bear': 0.2, 'chair': 0.1,
}
# fmt: on
DYNAMIC_PRIOR: dict[str, float] = {**_MOVES_BY_ITSELF, **_MOVES_WITH_SOMEBODY, **_IS_CARRIED}


def dynamic_prior(class_name: str) -> float:
    """Return the prior, in [0, 1], that an object of this class moves; 0 for unknown names."""
    return DYNAMIC_PRIOR.get(class_name, 0.0)


def p_dynamic(class_name: str, score: float) -> float:
    """
    Return the probability that a detection of a class, with a score in [0, 1], moves.

    The score is a probability that there is such an object, but networks of this size are shy:
    1 - (1 - score)^2 takes a person seen with 0.35 just above one half and one with 0.8 to 0.91.
    """
    return dynamic_prior(class_name) * (1.0 - (1.0 - score) ** 2)
