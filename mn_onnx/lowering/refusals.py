"""Operators that cannot become piecewise-linear functions of a point, with reasons and remedies."""

from __future__ import annotations

from mn_onnx.lowering.table import Refusal

_COUPLED = Refusal(
    "it divides by a norm or variance over all features, which is not piecewise linear",
    "train without this normalisation, or with batch or weight normalisation, which are affine once trained",
)
_RANDOM = Refusal(
    "its result is random, so the network is no function of the point",
    "call model.eval() before the export, and remove noise layers",
    never_fold=True,
)
_ROUNDED = Refusal(
    "it rounds activations, which makes the field piecewise constant",
    "export the network before quantisation, or quantise its weights only",
)
_RECURRENT = Refusal("recurrent layers multiply gates that depend on the points", "use a feed-forward network")
_ATTENTION = Refusal("attention multiplies tensors that both depend on the points", "use a network without attention")
_SAMPLED = Refusal(
    "it looks up or resamples values at places that depend on the points, which multiplies coordinates",
    "extract networks of coordinates only; grids and hash tables are not piecewise linear",
)
_KERNELS = Refusal(
    "it sums kernels of distances or products over support vectors, which is not piecewise linear",
    "use a linear model or a multi-layer perceptron",
)
_TREES = Refusal("its result is piecewise constant", "export a regressor with a continuous output")
_POSITIONS = Refusal(
    "its result jumps from point to point", "choose the output in front of it, the scores instead of the label"
)
_DATA_SHAPE = Refusal(
    "the shape of its output depends on the values of the points", "export without data-dependent shapes"
)
_SOFTMAX = Refusal("it couples all channels", "export the logits in front of it, and choose a channel")

REFUSALS: dict[tuple[str, str], Refusal] = {
    ("", operator): refusal
    for refusal, operators in (
        (
            _COUPLED,
            "LayerNormalization InstanceNormalization GroupNormalization RMSNormalization LpNormalization "
            "MeanVarianceNormalization LRN LpPool GlobalLpPool",
        ),
        (_RANDOM, "RandomNormal RandomNormalLike RandomUniform RandomUniformLike Multinomial Bernoulli"),
        (
            _ROUNDED,
            "QuantizeLinear DynamicQuantizeLinear MatMulInteger ConvInteger QLinearMatMul QLinearConv BitShift",
        ),
        (_RECURRENT, "LSTM GRU RNN"),
        (_ATTENTION, "Attention RotaryEmbedding"),
        (_SAMPLED, "GridSample Resize Upsample RoiAlign MaxRoiPool AffineGrid DeformConv"),
        (_POSITIONS, "ArgMax ArgMin Hardmax"),
        (_DATA_SHAPE, "NonZero Unique NonMaxSuppression StringSplit"),
        (_SOFTMAX, "SoftmaxCrossEntropyLoss NegativeLogLikelihoodLoss"),
    )
    for operator in operators.split()
} | {
    (domain, operator): refusal
    for domain, refusal, operators in (
        ("ai.onnx.ml", _TREES, "TreeEnsemble TreeEnsembleRegressor TreeEnsembleClassifier"),
        ("ai.onnx.ml", _POSITIONS, "LabelEncoder LinearClassifier SVMClassifier ZipMap"),
        ("ai.onnx.ml", _COUPLED, "Normalizer"),
        ("ai.onnx.ml", _KERNELS, "SVMRegressor"),
        ("com.microsoft", _COUPLED, "SkipLayerNormalization SimplifiedLayerNormalization EmbedLayerNormalization"),
        ("com.microsoft", _ATTENTION, "Attention MultiHeadAttention GroupQueryAttention"),
        (
            "com.microsoft",
            _ROUNDED,
            "QGemm QLinearAdd QLinearMul QLinearSigmoid QLinearLeakyRelu QAttention QuantizeLinear "
            "MatMulIntegerToFloat DynamicQuantizeMatMul DynamicQuantizeLSTM",
        ),
        (
            "com.microsoft",
            Refusal("weights packed for onnxruntime are not supported", "export the network before this quantisation"),
            "MatMulFpQ4 MatMulBnb4",
        ),
    )
    for operator in operators.split()
}
