"""Fit a ReLU network to the signed distance of a mesh, and export it to ONNX.

    pip install "mn-onnx[fit]"
    python models/fit_sdf.py bunny.obj -o bunny.onnx
    mn-onnx extract bunny.onnx -o bunny-exact.ply

Reads what trimesh reads. The mesh is centred and scaled so that its longest side is 1.8 of the box [-1, 1]^3; the
metadata of the exported model say how: network coordinates are (mesh coordinates - ``centre``) * ``scale``.
Signs come from fast winding numbers (Barill et al. 2018, through libigl), so small holes in the mesh do no harm.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np
import onnx
import torch
import trimesh
from numpy.typing import NDArray
from torch import nn

Floats = NDArray[np.float64]

LONGEST_SIDE = 1.8
NOISE_SCALES = (0.003, 0.02, 0.1)
UNIFORM_SHARE = 0.2


@dataclass(frozen=True)
class NormalizedMesh:
    """A triangle mesh in the network's box, and the map from the original coordinates."""

    vertices: Floats
    faces: NDArray[np.int64]
    centre: Floats
    scale: float

    @classmethod
    def load(cls, path: Path) -> NormalizedMesh:
        """Read a mesh file; exits with a message if there is none or it has no area."""
        try:
            mesh = trimesh.load_mesh(path)
        except (OSError, ValueError, NotImplementedError) as error:
            sys.exit(f"cannot read the mesh {path}: {error}")
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces) or not mesh.area > 0:
            sys.exit(f"{path} holds no triangles with area")
        lower, upper = mesh.bounds
        centre = (lower + upper) / 2
        scale = float(LONGEST_SIDE / (upper - lower).max())
        return cls((mesh.vertices - centre) * scale, np.asarray(mesh.faces, np.int64), centre, scale)

    def signed_distance(self, points: Floats) -> Floats:
        """The distance of ``points`` [n, 3] to the surface, negative inside: float64 [n]."""
        kind = igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
        return np.asarray(igl.signed_distance(points, self.vertices, self.faces, kind)[0], np.float64)

    def sample(self, count: int, generator: np.random.Generator) -> Floats:
        """Training points [count, 3]: some uniform in the box, the rest near the surface at several scales."""
        uniform = generator.uniform(-1, 1, (int(UNIFORM_SHARE * count), 3))
        surface = trimesh.Trimesh(self.vertices, self.faces, process=False)
        on_surface, _ = trimesh.sample.sample_surface(surface, count - len(uniform), seed=generator)
        scales = generator.choice(NOISE_SCALES, (len(on_surface), 1))
        near = on_surface + scales * generator.standard_normal(on_surface.shape)
        return np.concatenate([uniform, np.clip(near, -1, 1)])


class SignedDistanceNetwork(nn.Module):
    """A multilayer perceptron with ReLU; ``skip`` names the hidden layer that also gets the point itself (0: none)."""

    def __init__(self, width: int, depth: int, skip: int) -> None:
        super().__init__()
        self.skip = skip
        inputs = [3] + [width + 3 * (layer == skip) for layer in range(1, depth)]
        self.hidden = nn.ModuleList(nn.Linear(size, width) for size in inputs)
        self.last = nn.Linear(width, 1)

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        """The signed distance [n, 1] at ``points`` [n, 3]."""
        features = points
        for layer, linear in enumerate(self.hidden):
            if layer and layer == self.skip:
                features = torch.cat([features, points], dim=1)
            features = torch.relu(linear(features))
        return self.last(features)


def fit(
    network: SignedDistanceNetwork,
    points: Floats,
    distances: Floats,
    *,
    steps: int,
    batch: int,
    learning_rate: float,
    generator: np.random.Generator,
    device: torch.device,
) -> float:
    """Train with Adam on the absolute error; returns its mean over all points at the end."""
    inputs = torch.from_numpy(points.astype(np.float32)).to(device)
    targets = torch.from_numpy(distances.astype(np.float32)).to(device)[:, None]
    network.to(device)
    optimizer = torch.optim.Adam(network.parameters(), lr=learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, eta_min=learning_rate / 100)
    for step in range(1, steps + 1):
        chosen = torch.from_numpy(generator.integers(0, len(points), batch)).to(device)
        loss = (network(inputs[chosen]) - targets[chosen]).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if step % max(1, steps // 10) == 0:
            print(f"step {step:>7,} of {steps:,}: mean |error| {loss.item():.5f}", flush=True)
    with torch.no_grad():
        errors = [
            (network(part) - target).abs().sum()
            for part, target in zip(inputs.split(2**16), targets.split(2**16), strict=True)
        ]
    return float(torch.stack(errors).sum() / len(points))


def export(network: SignedDistanceNetwork, path: Path, metadata: dict[str, str]) -> None:
    """Write ``network`` to ``path`` with a free number of points, its weights and ``metadata`` inside the file."""
    example = (torch.zeros(2, 3),)
    shapes = {"points": {0: torch.export.Dim("n")}}
    program = torch.onnx.export(
        network.cpu().eval(),
        example,
        input_names=["points"],
        output_names=["sdf"],
        dynamic_shapes=shapes,
        dynamo=True,
        verbose=False,
    )
    model = program.model_proto
    onnx.helper.set_model_props(model, metadata)
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description="Fit a ReLU signed-distance network to a mesh and export it to ONNX.")
    parser.add_argument("mesh", type=Path, help="mesh file (.obj, .ply, .stl, .off, .glb, ...)")
    parser.add_argument("-o", "--output", type=Path, required=True, help="ONNX file to write")
    parser.add_argument("--width", type=int, default=128, help="units per hidden layer (default 128)")
    parser.add_argument("--depth", type=int, default=3, help="hidden layers (default 3)")
    parser.add_argument(
        "--skip", type=int, default=0, help="hidden layer (from 1) that also reads the point (default none)"
    )
    parser.add_argument("--steps", type=int, default=20_000, help="training steps (default 20,000)")
    parser.add_argument("--batch", type=int, default=8192, help="points per step (default 8,192)")
    parser.add_argument("--samples", type=int, default=1_000_000, help="points drawn from the mesh (default 1,000,000)")
    parser.add_argument("--learning-rate", type=float, default=2e-3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    options = parser.parse_args()
    for name in ("width", "depth", "steps", "batch", "samples"):
        if getattr(options, name) < 1:
            parser.error(f"--{name} must be at least 1")
    if not 0 <= options.skip < options.depth:
        parser.error(f"--skip must be between 1 and {options.depth - 1}, the last hidden layer, or 0 for none")
    if not options.output.absolute().parent.is_dir():
        parser.error(f"there is no folder {options.output.absolute().parent}")
    return options


def main() -> None:
    """Read, sample, train, export."""
    options = parse_arguments()
    torch.manual_seed(options.seed)
    generator = np.random.default_rng(options.seed)
    mesh = NormalizedMesh.load(options.mesh)
    print(f"{options.mesh}: {len(mesh.faces):,} triangles; sampling {options.samples:,} distances", flush=True)
    points = mesh.sample(options.samples, generator)
    network = SignedDistanceNetwork(options.width, options.depth, options.skip)
    error = fit(
        network,
        points,
        mesh.signed_distance(points),
        steps=options.steps,
        batch=options.batch,
        learning_rate=options.learning_rate,
        generator=generator,
        device=torch.device(options.device),
    )
    metadata = {
        "bounds": "[-1, 1]",
        "centre": json.dumps(mesh.centre.tolist()),
        "scale": json.dumps(mesh.scale),
        "source": options.mesh.name,
    }
    export(network, options.output, metadata)
    print(f"{options.output}: ReLU {options.depth} x {options.width}, mean |error| {error:.5f} over the samples")


if __name__ == "__main__":
    main()
