"""What transforms share that read observations at the root of a step and under "next" of a replay batch."""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data.tensor_specs import Composite

from crptpro.transforms.keys import is_next

KeyPair = tuple[NestedKey, NestedKey]


class OnRootKeys:
    """Mix-in: on an environment only root keys count, at each reset and each step.

    Keys under ``"next"`` belong to replay batches: what they name there is the root entry of the next step
    here. A subclass lists its (in key, out key) pairs in ``_pairs`` and writes ``_apply_to`` and
    ``transform_observation_spec``.
    """

    _pairs: list[KeyPair]

    def _root_pairs(self) -> list[KeyPair]:
        return [pair for pair in self._pairs if not is_next(pair[0])]

    def _apply_to(self, tensordict: TensorDictBase, pairs: list[KeyPair]) -> TensorDictBase:
        raise NotImplementedError

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._apply_to(next_tensordict, self._root_pairs())

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._apply_to(tensordict_reset, self._root_pairs())

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Register what the root pairs write."""
        raise NotImplementedError

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """Register new root keys; keys under ``"next"`` belong to replay batches and are not an env's."""
        output_spec = output_spec.clone()
        observation_spec = output_spec["full_observation_spec"]
        output_spec["full_observation_spec"] = self.transform_observation_spec(observation_spec)
        return output_spec
