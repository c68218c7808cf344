from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, ReplayBuffer

from crptpro.analysis.embeddings import embed_pixels, embed_samples, principal_components


def dataset(brightness: int) -> ReplayBuffer:
    """Ten observations, each a constant of its own: the i-th is ``brightness + i``."""
    buffer = ReplayBuffer(storage=LazyTensorStorage(10), batch_size=4)
    pixels = (brightness + torch.arange(10)).to(torch.uint8).view(10, 1, 1, 1).expand(10, 9, 8, 8)
    buffer.extend(TensorDict({"pixels": pixels.clone()}, [10]))
    return buffer


class Brightness(nn.Module):
    """An encoder whose feature is the mean pixel; says where its pixels were."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(1))

    def forward(self, pixels: Tensor) -> Tensor:
        self.seen = pixels.device.type
        return self.weight * pixels.flatten(1).double().mean(1, keepdim=True)


def test_embeddings_are_the_features_of_sampled_observations_by_domain() -> None:
    embeddings = embed_samples(Brightness(), {"dark": dataset(10), "bright": dataset(200)}, samples=50)
    assert list(embeddings) == ["dark", "bright"]
    for name, low in (("dark", 10), ("bright", 200)):
        points = embeddings[name]
        assert points.shape == (50, 1)
        assert points.dtype == torch.float32
        assert not points.requires_grad
        assert low <= points.min() < points.max() <= low + 9


def test_a_projectors_outputs_are_the_embeddings_where_one_is_given() -> None:
    domains = {"a": dataset(10)}
    features = embed_samples(Brightness(), domains)["a"]
    projected = embed_samples(Brightness(), domains, projector=nn.Linear(1, 3, dtype=torch.float64))["a"]
    assert features.shape == (125, 1)
    assert projected.shape == (125, 3)


def test_the_seed_chooses_the_observations_and_the_datasets_own_stream_goes_on() -> None:
    encoder, buffer, twin = Brightness(), dataset(0), dataset(0)
    for each in (buffer, twin):
        each.set_rng(torch.Generator().manual_seed(5))
    first, second, other = (embed_samples(encoder, {"a": buffer}, seed=seed)["a"] for seed in (1, 1, 2))
    assert torch.equal(first, second)
    assert not torch.equal(first, other)
    assert torch.equal(buffer.sample(20)["pixels"], twin.sample(20)["pixels"])


def test_a_dataset_that_follows_the_global_generator_still_does_afterwards() -> None:
    buffer = dataset(0)
    embed_samples(Brightness(), {"a": buffer})
    draws = []
    for _ in range(2):
        torch.manual_seed(3)
        draws.append(buffer.sample(20)["pixels"])
    assert torch.equal(*draws)


@pytest.mark.gpu
def test_a_dataset_on_a_gpu_is_drawn_from_there() -> None:
    storage = LazyTensorStorage(10, device="cuda")
    buffer = ReplayBuffer(storage=storage, batch_size=4)
    buffer.extend(dataset(10).sample(10).select("pixels").to("cuda"))
    assert embed_samples(Brightness().cuda(), {"a": buffer})["a"].device.type == "cuda"


def test_pixels_are_encoded_where_the_encoder_lives() -> None:
    encoder = Brightness().to("meta")
    assert embed_samples(encoder, {"a": dataset(0)})["a"].device.type == encoder.seen == "meta"


def test_components_explain_variance_in_decreasing_order_and_reconstruct_the_points() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(40, 5, generator=generator, dtype=torch.float64) * torch.tensor([5.0, 3, 2, 1, 0.1])
    coordinates, explained = principal_components(points, components=5)
    assert (explained.diff() <= 0).all()
    torch.testing.assert_close(explained.sum(), torch.ones((), dtype=torch.float64))
    centred = points - points.mean(0)
    torch.testing.assert_close(coordinates @ coordinates.T, centred @ centred.T)


def test_components_agree_with_the_eigenvectors_of_the_covariance() -> None:
    points = torch.randn(60, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    coordinates, explained = principal_components(points, components=2)
    eigenvalues = torch.linalg.eigvalsh(torch.cov(points.T)).flip(0)
    torch.testing.assert_close(coordinates.var(0), eigenvalues[:2])
    torch.testing.assert_close(explained, eigenvalues[:2] / eigenvalues.sum())


def test_too_many_components_are_refused_with_the_limit_in_the_message() -> None:
    with pytest.raises(ValueError, match=r"at most min.* = 3, got 4"):
        principal_components(torch.randn(3, 10), components=4)


@pytest.mark.parametrize(("count", "components"), [(1, 1), (0, 1)])
def test_fewer_than_two_points_have_no_components(count: int, components: int) -> None:
    with pytest.raises(ValueError, match=f"at least 2, got {count}"):
        principal_components(torch.randn(count, 4), components=components)


def test_more_pixels_than_fit_at_once_give_the_same_embeddings() -> None:
    encoder = Brightness()
    pixels = torch.arange(150, dtype=torch.uint8).view(150, 1, 1, 1).expand(150, 9, 8, 8)
    assert torch.equal(embed_pixels(encoder, pixels), torch.arange(150.0).unsqueeze(1))
    projector = nn.Linear(1, 3, dtype=torch.float64)
    assert embed_pixels(encoder, pixels, projector=projector).shape == (150, 3)
