"""An encoder of clips: several views and sensors, some of which may be missing."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from repdib_lightning.encoders.base import Encoder, EncoderOutput
from repdib_lightning.encoders.clip_modalities import clip_modalities, sequences_among
from repdib_lightning.encoders.frame_differences import check_frame_input
from repdib_lightning.encoders.frame_sequences import FeatureSequence, FrameSequence
from repdib_lightning.encoders.modality_dropout import drop_modalities
from repdib_lightning.encoders.modality_fusion import build_fusion
from repdib_lightning.encoders.sensor_augmentation import SensorAugmentation
from repdib_lightning.encoders.sensor_sequences import SensorSequence
from repdib_lightning.encoders.unimodal import UnimodalEncoder
from repdib_lightning.encoders.unimodal_bottlenecks import UnimodalBottlenecks, mean_values
from repdib_lightning.encoders.views import seen_only
from repdib_lightning.errors import UserError
from repdib_lightning.records import DataSpec


class MultimodalEncoder(Encoder):
    """Each modality to a vector, then the vectors to one (HAMLET, Islam and Iqbal 2020; Keyless, Long et al. 2018).

    A modality's steps are frames or windows of readings, encoded one by one and by an LSTM, pooled over time,
    normalised, and passed through a bottleneck of its own where one is given (the paper's RepDIB+Uni). The modalities
    are fused, and ``Linear -> LayerNorm`` gives M. What is missing, be it steps or modalities, enters nowhere; samples
    never mix, except in the codebooks of bottlenecks.

    ``pooling`` and ``fusion`` make the published models: HAMLET is attention in both, Keyless keyless in both, the
    paper's own weighting is ``weighting``.

    Args:
        spec: observations; videos and sequences of any size.
        features: M.
        modalities: names of the observations to use; all videos and sequences by default.
        width: d, of the vector of each modality, and of its LSTM.
        layers: of each LSTM; 0 for none.
        dropout: of what enters the LSTMs, between their layers, and of the fused vector.
        pooling: over time, ``attention``, ``keyless`` or ``statistics``.
        fusion: over modalities, ``attention``, ``keyless`` or ``weighting``.
        join: what fusion does with the weighted vectors, ``sum`` or ``concat``.
        heads: of attention, over time and over modalities.
        bottleneck: name of a class, ``RepDIB`` say: one of its own for each modality; none by default.
        bottleneck_options: its options.
        modality_dropout: chance that a training clip loses a modality before the fusion; the last one stays.
        network: of each frame: ``small``, ``resnet18``, ``resnet34`` or ``resnet50``.
        norm: of the ResNets: ``group``, or ``frozen``, the batch statistics that ``weights`` hold.
        weights: file of torchvision's weights that the ResNets start from. A bundle does not hold its name.
        frame_input: what the networks see of each frame: ``frames``, their ``differences`` from the mean frame of the
            clip (before a camera that stands still: what moves), or ``both``.
        segments: frames taken of each video, one of each of so many equal parts; 0 for all.
        frame_features: names of sequences that hold features of frames, computed before.
        sensor_network: of each window of readings: ``convolution``, or hand-made ``statistics``.
        window: readings of a window.
        stride: readings from one window to the next.
        channels: of the convolutions over readings.
        angles: names of sequences in degrees, which enter as sine and cosine.
        reflection: see :class:`SensorAugmentation`, as the rest: chance that a training clip is mirrored.
        rotation: degrees by which worn devices are turned in training.
        rotated: names of the sequences that turn; acceleration and gyroscope by default.
        scaling: deviation of a sensor's factor.
        jitter: deviation of the noise, in those of the channel.
        time_warp: deviation of the speed.

    Raises:
        UserError: unknown names or choices, sizes out of range, or what a part complains of.
    """

    forgotten = ("weights",)

    def __init__(
        self,
        spec: DataSpec,
        *,
        features: int = 128,
        modalities: list[str] | None = None,
        width: int = 128,
        layers: int = 1,
        dropout: float = 0.2,
        pooling: Literal["attention", "keyless", "statistics"] = "attention",
        fusion: Literal["attention", "keyless", "weighting"] = "attention",
        join: Literal["sum", "concat"] = "sum",
        heads: int = 2,
        bottleneck: str | None = None,
        bottleneck_options: dict[str, bool | int | float | str] | None = None,
        modality_dropout: float = 0.0,
        network: Literal["small", "resnet18", "resnet34", "resnet50"] = "small",
        norm: Literal["group", "frozen"] = "group",
        weights: str | None = None,
        frame_input: Literal["frames", "differences", "both"] = "frames",
        segments: int = 8,
        frame_features: list[str] | None = None,
        sensor_network: Literal["convolution", "statistics"] = "convolution",
        window: int = 5,
        stride: int = 5,
        channels: int = 64,
        angles: list[str] | None = None,
        reflection: float = 0.0,
        rotation: float = 0.0,
        rotated: list[str] | None = None,
        scaling: float = 0.0,
        jitter: float = 0.0,
        time_warp: float = 0.0,
    ) -> None:
        names = clip_modalities(spec, modalities)
        super().__init__(seen_only(spec, names), features)
        _at_least(1, width=width, window=window, stride=stride, channels=channels)
        _at_least(0, layers=layers, segments=segments)
        check_frame_input(frame_input)
        _chances(dropout=dropout, modality_dropout=modality_dropout)
        self.modalities, self.modality_dropout = names, modality_dropout

        precomputed = sequences_among(self.spec, "frame_features", frame_features)
        sequences = [name for name in names if self.spec.observations[name].is_sequence]
        readings = seen_only(self.spec, [name for name in sequences if name not in precomputed])
        angles = sequences_among(readings, "angles", angles)
        self.augmentation = SensorAugmentation(
            readings,
            angles,
            reflection=reflection,
            rotation=rotation,
            rotated=None if rotated is None else sequences_among(readings, "rotated", rotated),
            scaling=scaling,
            jitter=jitter,
            time_warp=time_warp,
        )
        self.unimodal = nn.ModuleDict()
        for name, array in self.spec.observations.items():
            if array.is_video:
                sequence: nn.Module = FrameSequence(
                    array.shape,
                    width,
                    network=network,
                    norm=norm,
                    weights=weights,
                    frame_input=frame_input,
                    segments=segments,
                    layers=layers,
                    dropout=dropout,
                )
            elif name in precomputed:
                sequence = FeatureSequence(array.shape, width, segments=segments, layers=layers, dropout=dropout)
            else:
                sequence = SensorSequence(
                    name,
                    array,
                    width,
                    network=sensor_network,
                    window=window,
                    stride=stride,
                    channels=channels,
                    layers=layers,
                    dropout=dropout,
                    angles=name in angles,
                )
            self.unimodal[name] = UnimodalEncoder(sequence, width, pooling=pooling, heads=heads)
        self.bottlenecks = UnimodalBottlenecks(bottleneck, bottleneck_options, names, width)
        self.fusion = build_fusion(fusion, width, len(names), join=join, heads=heads)
        self.trunk = nn.Sequential(nn.Dropout(dropout), nn.Linear(self.fusion.width, features), nn.LayerNorm(features))

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Encode name -> (N, T, ...) into (N, M)."""
        return self.detailed(observations).features

    def detailed(self, observations: dict[str, Tensor]) -> EncoderOutput:
        """The same with losses and metrics of the inner bottlenecks, ``unimodal_*`` (means over modalities), and more.

        Codes are -1 where the modality is missing. Attention over modalities is in the order of ``modalities``.
        """
        clips = self.augmentation({name: observations[name] for name in self.modalities})
        vectors, present, attention = {}, {}, {}
        for name in self.modalities:
            vectors[name], present[name], attention[name] = self.unimodal[name](clips[name])
        outputs = self.bottlenecks(vectors, present)
        seen = torch.stack([present[name] for name in self.modalities], dim=1)
        if self.training:
            seen = drop_modalities(seen, self.modality_dropout)
        latents = torch.stack([outputs[name].latent for name in self.modalities], dim=1)
        fused, attention["modalities"] = self.fusion(latents, seen)
        return EncoderOutput(
            self.trunk(fused),
            mean_values([output.losses for output in outputs.values()]),
            mean_values([output.metrics for output in outputs.values()]),
            {name: output.codes for name, output in outputs.items() if output.codes is not None},
            {name: weights.detach() for name, weights in attention.items()},
        )

    def require_ready(self) -> None:
        """Raise UserError, naming the modality, unless each inner bottleneck is ready."""
        self.bottlenecks.require_ready()


def _at_least(least: int, **sizes: int) -> None:
    for option, size in sizes.items():
        if size < least:
            raise UserError(f"MultimodalEncoder: {option} must be at least {least}, is {size}")


def _chances(**chances: float) -> None:
    for option, chance in chances.items():
        if not 0 <= chance < 1:
            raise UserError(f"MultimodalEncoder: {option} must be in [0, 1), is {chance}")
