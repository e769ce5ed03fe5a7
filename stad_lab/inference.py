"""V's encoder and M's memory, compiled: what drives the cars, in every frame of every episode.

`models` has the networks as students read them and as they are trained. Here the same arithmetic
runs on the CPU without PyTorch, whose calls cost more than the arithmetic if the batch is small: V
takes a sixth of PyTorch's time for one car, and two thirds of it for 16.

Everything is one operation, a layer: a patch of the input, times a matrix, plus a bias. For a
convolution the patch is what lies below its kernel; for M it is z, the action and h side by side.
The patches of several pixels or cars are multiplied together, because each weight that was read
then serves for all of them. `tile` does 6 patches times 16 or 32 outputs: as many sums as fit into
the processor's registers, so that only inputs and weights are read from memory. (This is how matrix
libraries do it: Goto and van de Geijn 2008.)

A sum is made in one order, whatever the batch or the width of the processor's vectors: a car's
numbers do not depend on the other cars of the batch.
"""

import copy
import functools
import itertools
from typing import NamedTuple

import numpy as np
import torch
from numba.core import types
from numba.core.cgutils import ir
from numba.core.codegen import get_host_cpu_features
from numba.extending import intrinsic

from stad_lab.envs.compiling import compiled
from stad_lab.envs.frames import FRAME_SIZE, normalise, to_pictures
from stad_lab.models.mdn_rnn import MDNRNN, to_state
from stad_lab.models.vae import VAE, to_tensor

PATCHES, OUTPUTS = 6, 16  # of a tile: 12 vectors of AVX2, which has 16 registers
BLOCKS = 2 if "+avx512f" in get_host_cpu_features() else 1  # of OUTPUTS in a tile: 12 of 32 vectors
TOLERANCE = 1e-3  # between the compiled numbers and PyTorch's, as a share of the largest
PIXELS = normalise(np.arange(256, dtype=np.uint8))  # every value that a pixel of a frame can have


class Layer(NamedTuple):
    """A layer for a number of cars; float32, in memory with the channels last.

    A patch is `rows` runs of `run` numbers of the input, which begin `row` numbers apart.
    """

    starts: np.ndarray  # where in the input each patch begins, int64 (patches,)
    rows: int
    row: int
    run: int
    weights: np.ndarray  # (outputs / OUTPUTS, rows x run, OUTPUTS), outputs filled up with zeros
    bias: np.ndarray  # (outputs,)
    floor: float  # least output: 0 for a ReLU, minus infinity for none


@intrinsic(prefer_literal=True)
def tile(typing_context, x, starts, layer_shape, weights, bias, y, ends, blocks):
    """Write the sums of PATCHES patches for `blocks` times OUTPUTS outputs; see `run_layer`.

    Written for LLVM, because no loop in Python makes Numba keep the sums in registers.
    """
    signature = types.void(x, starts, layer_shape, weights, bias, y, ends, blocks)

    def generate(context, builder, signature, arguments):
        def pointer(position):
            kind = signature.args[position]
            return context.make_array(kind)(context, builder, arguments[position]).data

        def unpack(position):
            return [
                builder.extract_value(arguments[position], i)
                for i in range(len(signature.args[position]))
            ]

        vector, integer = ir.VectorType(ir.FloatType(), OUTPUTS), ir.IntType(64)
        all_zero = ir.Constant(ir.VectorType(ir.IntType(32), OUTPUTS), [0] * OUTPUTS)
        undefined, zero, one = ir.Constant(vector, ir.Undefined), integer(0), integer(1)
        inputs, outputs, wide = pointer(0), pointer(5), range(signature.args[7].literal_value)
        rows, row, run, floor = unpack(2)

        def address(array, *distances):
            index = functools.reduce(builder.add, distances)
            return builder.bitcast(builder.gep(array, [index]), vector.as_pointer())

        def spread(scalar):
            first = builder.insert_element(undefined, scalar, ir.IntType(32)(0))
            return builder.shuffle_vector(first, undefined, all_zero)

        def begin_loop(name, *variables):
            before, block = builder.block, builder.append_basic_block(name)
            builder.branch(block)
            builder.position_at_end(block)
            phis = [builder.phi(variable.type) for variable in variables]
            for phi, variable in zip(phis, variables, strict=True):
                phi.add_incoming(variable, before)
            return block, phis

        def end_loop(block, phis, values, goes_on):
            for phi, value in zip(phis, values, strict=True):
                phi.add_incoming(value, builder.block)
            after = builder.append_basic_block("after")
            builder.cbranch(goes_on, block, after)
            builder.position_at_end(after)

        columns = [integer(OUTPUTS * block) for block in wide]
        size = builder.mul(builder.mul(rows, run), integer(OUTPUTS))  # of the weights of a block
        skipped = [builder.mul(size, integer(block)) for block in wide]
        begin = [builder.load(address(pointer(4), column), align=4) for column in columns]
        patches, sums = unpack(1), begin * PATCHES
        outer, (number, base, weight, *sums) = begin_loop("row", zero, zero, zero, *sums)
        end = builder.add(base, run)
        inner, (at, at_weight, *partial) = begin_loop("run", base, weight, *sums)
        factors = [builder.load(address(pointer(3), at_weight, part), align=4) for part in skipped]
        values = [builder.load(builder.gep(inputs, [builder.add(start, at)])) for start in patches]
        added = []
        pairs = itertools.product(map(spread, values), factors)
        for (value, factor), total in zip(pairs, partial, strict=True):
            # "contract": multiply and add in one instruction, rounded once.
            product = builder.fmul(value, factor, flags=["contract"])
            added.append(builder.fadd(product, total, flags=["contract"]))
        following = builder.add(at, one)
        next_weight = builder.add(at_weight, integer(OUTPUTS))
        goes_on = builder.icmp_signed("<", following, end)
        end_loop(inner, (at, at_weight, *partial), (following, next_weight, *added), goes_on)
        next_row = builder.add(number, one)
        values = next_row, builder.add(base, row), next_weight, *added
        goes_on = builder.icmp_signed("<", next_row, rows)
        end_loop(outer, (number, base, weight, *sums), values, goes_on)
        least = spread(floor)
        for (place, column), total in zip(
            itertools.product(unpack(6), columns), added, strict=True
        ):
            kept = builder.select(builder.fcmp_ordered("<", total, least), least, total)
            builder.store(kept, address(outputs, place, column), align=4)
        return context.get_dummy_value()

    return signature, generate


@compiled
def run_layer(x: np.ndarray, layer: Layer, y: np.ndarray) -> None:
    """y = max(patches of x times weights + bias, floor); x, y flat, y (patches x outputs)."""
    starts, width, last = layer.starts, len(layer.bias), len(layer.starts) - 1
    shape = layer.rows, layer.row, layer.run, np.float32(layer.floor)
    blocks = len(layer.weights)
    step = BLOCKS if blocks % BLOCKS == 0 else 1
    for block in range(0, blocks, step):  # their weights stay in the cache
        weights, to = layer.weights[block:].ravel(), OUTPUTS * block
        bias = layer.bias[to:]
        for first in range(0, last + 1, PATCHES):
            # A last tile with fewer patches repeats one.
            a, b, c = first, min(first + 1, last), min(first + 2, last)
            d, e, f = min(first + 3, last), min(first + 4, last), min(first + 5, last)
            begin = starts[a], starts[b], starts[c], starts[d], starts[e], starts[f]
            ends = (
                a * width + to, b * width + to, c * width + to,
                d * width + to, e * width + to, f * width + to,
            )  # fmt: skip
            if step == 1:
                tile(x, begin, shape, weights, bias, y, ends, 1)
            else:
                tile(x, begin, shape, weights, bias, y, ends, BLOCKS)


@compiled
def write_pictures(frames, earlier, pictures):
    """What V sees of uint8 (cars, 64, 64, 3): float32 (cars, 64, 64, 3), or 6 with differences."""
    channels = pictures.shape[-1]
    for car in range(len(frames)):
        for row in range(FRAME_SIZE):
            for column in range(FRAME_SIZE):
                for color in range(3):
                    value = PIXELS[frames[car, row, column, color]]
                    pictures[car, row, column, color] = value
                    if channels == 6:
                        before = PIXELS[earlier[car, row, column, color]]
                        pictures[car, row, column, 3 + color] = value - before


@compiled
def run_encoder(frames, earlier, pictures, layers, first, second):
    """The last layer's outputs; `pictures`, `first` and `second` are memory to work in."""
    write_pictures(frames, earlier, pictures)
    x, y, other = pictures.reshape(-1), first, second
    for layer in layers:
        run_layer(x, layer, y)
        x, y, other = y, other, y
    return x


@compiled(error_model="numpy")
def run_memory(layer, seen, gates, state):
    """One step of an LSTM: `state` (2, cars, hidden), h and c, is changed in place."""
    hidden = state.shape[2]
    run_layer(seen.reshape(-1), layer, gates.reshape(-1))
    one = np.float32(1)
    for car in range(state.shape[1]):
        own = gates[car]
        for i in range(hidden):
            keep = one / (one + np.exp(-own[hidden + i]))
            write = one / (one + np.exp(-own[i])) * np.tanh(own[2 * hidden + i])
            state[1, car, i] = keep * state[1, car, i] + write
            show = one / (one + np.exp(-own[3 * hidden + i]))
            state[0, car, i] = show * np.tanh(state[1, car, i])


class Inference:
    """V's encoder and M's memory for driving. It has memory to work in: one for each thread.

    Weights are copied: an Inference does not follow a training.

    Raises:
        ValueError: a network of another architecture than what is compiled here.
    """

    def __init__(self, vae: VAE, mdn_rnn: MDNRNN):
        self.channels, self.latent_size = vae.encoder[0].in_channels, vae.latent_size
        self.encoder, self.memory = pack_encoder(vae), pack_memory(mdn_rnn)
        self.cars = 0
        compare(self, vae, mdn_rnn)

    def encode(self, frames: np.ndarray, earlier: np.ndarray) -> np.ndarray:
        """V's mean mu of z, float32 (cars, latent_size).

        Args:
            frames: uint8 (cars, 64, 64, 3).
            earlier: the frames that are subtracted from these for the difference images.
        """
        self._prepare(len(frames))
        memory = self._first, self._second
        encoded = run_encoder(frames, earlier, self._pictures, self._layers, *memory)
        width = len(self._layers[-1].bias)
        latents = encoded[: len(frames) * width].reshape(-1, width)
        return latents[:, : self.latent_size].copy()

    def remember(self, latents: np.ndarray, actions: np.ndarray, state: np.ndarray) -> np.ndarray:
        """M's memory h and c after z and an action, float32 (2, cars, hidden_size).

        Args:
            latents: float32 (cars, latent_size).
            actions: float32 (cars, 3).
            state: the memory before; it is not changed.
        """
        self._prepare(len(latents))
        seen, state = np.concatenate([latents, actions, state[0]], axis=1), state.copy()
        run_memory(self._memory, seen, self._gates, state)
        return state

    def _prepare(self, cars: int) -> None:
        """Layers, and memory to work in, for so many cars."""
        if cars == self.cars:
            return
        self.cars, size, channels, layers = cars, FRAME_SIZE, self.channels, []
        for weights, bias, kernel, stride in self.encoder[:-1]:
            starts = convolution_starts(cars, size, channels, kernel, stride)
            shape = kernel, size * channels, kernel * channels
            layers.append(Layer(starts, *shape, weights, bias, 0.0))
            size, channels = (size - kernel) // stride + 1, len(bias)
        layers.append(dense_layer(cars, *self.encoder[-1]))
        self._layers, self._memory = tuple(layers), dense_layer(cars, *self.memory)
        largest = max(len(layer.starts) * len(layer.bias) for layer in layers)
        self._first, self._second = np.empty((2, largest), np.float32)
        self._pictures = np.empty((cars, FRAME_SIZE, FRAME_SIZE, self.channels), np.float32)
        self._gates = np.empty((cars, len(self._memory.bias)), np.float32)


Packed = tuple[np.ndarray, np.ndarray]  # weights and bias of a Layer


def pack(weights: np.ndarray, bias: np.ndarray) -> Packed:
    """Weights (inputs, outputs) and bias (outputs,) of a layer, filled up to whole tiles."""
    missing = -len(bias) % OUTPUTS
    weights = np.pad(weights, ((0, 0), (0, missing))).astype(np.float32)
    tiles = weights.reshape(len(weights), -1, OUTPUTS).transpose(1, 0, 2)
    return np.ascontiguousarray(tiles), np.pad(bias, (0, missing)).astype(np.float32)


def pack_encoder(vae: VAE) -> list[tuple]:
    """The layers of V's encoder: (weights, bias, kernel, stride), and of the last one for mu.

    ValueError unless they are convolutions without padding, each with a ReLU, and a linear layer.
    """
    *parts, _, last = vae.encoder
    convolutions, activations, packed, size = parts[::2], parts[1::2], [], FRAME_SIZE
    kinds = [type(part).__name__ for part in vae.encoder]
    if kinds != [*["Conv2d", "ReLU"] * len(activations), "Flatten", "Linear"]:
        raise refused("V", f"an encoder of {', '.join(kinds)}")
    if (channels := convolutions[0].in_channels) not in (3, 6):
        raise refused("V", f"{channels} input channels")
    for part in convolutions:
        kernel, stride = part.kernel_size[0], part.stride[0]
        usual = torch.nn.Conv2d(part.in_channels, part.out_channels, kernel, stride)
        if str(part) != str(usual) or part.bias is None:
            raise refused("V", str(part))
        packed.append((*pack_convolution(part.weight, part.bias, channels), kernel, stride))
        size, channels = (size - kernel) // stride + 1, len(packed[-1][1])
    kernel = last.weight[: vae.latent_size].unflatten(1, (-1, size, size))
    packed.append(pack_convolution(kernel, last.bias[: vae.latent_size], channels))
    return packed


@torch.no_grad()
def pack_convolution(kernel: torch.Tensor, bias: torch.Tensor, channels: int) -> Packed:
    """A kernel (outputs, inputs, rows, columns) with its inputs filled up to `channels`."""
    kernel = kernel.cpu().permute(2, 3, 1, 0).numpy()  # channels last, then outputs
    kernel = np.pad(kernel, ((0, 0), (0, 0), (0, channels - kernel.shape[2]), (0, 0)))
    return pack(kernel.reshape(-1, len(bias)), bias.cpu().numpy())


@torch.no_grad()
def pack_memory(mdn_rnn: MDNRNN) -> Packed:
    """M's LSTM: both of its matrices as one, for z, the action and h side by side.

    ValueError unless it is one layer of an LSTM without extras.
    """
    lstm = mdn_rnn.lstm
    if str(lstm) != str(torch.nn.LSTM(lstm.input_size, lstm.hidden_size, batch_first=True)):
        raise refused("M", str(lstm))
    weights = torch.cat([lstm.weight_ih_l0, lstm.weight_hh_l0], 1).cpu().numpy()
    return pack(weights.T, (lstm.bias_ih_l0 + lstm.bias_hh_l0).cpu().numpy())


@torch.no_grad()
def compare(inference: Inference, vae: VAE, mdn_rnn: MDNRNN) -> None:
    """Encode and remember once, by chance, here and in PyTorch; ValueError if they differ."""
    rng, hidden_size = np.random.default_rng(0), mdn_rnn.hidden_size
    frames, earlier = rng.integers(0, 256, (2, 1, FRAME_SIZE, FRAME_SIZE, 3), np.uint8)
    actions, memory = np.ones((1, 3), np.float32), np.zeros((2, 1, hidden_size), np.float32)
    vae, mdn_rnn = on_cpu(vae), on_cpu(mdn_rnn)
    latents = inference.encode(frames, earlier)
    check_equal("V", latents, vae.encode(*map(to_tensor, to_pictures(frames, earlier)))[0])
    memory = inference.remember(latents, actions, memory)
    seen = [torch.from_numpy(part)[:, None] for part in (latents, actions)]
    after = mdn_rnn.remember(*seen, to_state(memory))[1]
    check_equal("M", inference.remember(latents, actions, memory), torch.cat(after))


def on_cpu(network: torch.nn.Module) -> torch.nn.Module:
    """The network itself, or a copy of one on a GPU."""
    here = next(network.parameters()).device.type == "cpu"
    return network if here else copy.deepcopy(network).cpu()


def check_equal(network: str, ours: np.ndarray, theirs: torch.Tensor) -> None:
    """Raise ValueError unless compiled numbers are PyTorch's, up to rounding."""
    error = TOLERANCE * float(theirs.abs().nan_to_num().max())
    if ours.shape != theirs.shape or not np.allclose(ours, theirs, 0, error, equal_nan=True):
        raise refused(network, "numbers that the compiled ones do not equal")


def refused(network: str, found: str) -> ValueError:
    """The error for a network that is not compiled here."""
    return ValueError(
        f"{network} has {found}: what drives is compiled in inference.py, change both"
    )


def convolution_starts(cars: int, size: int, channels: int, kernel: int, stride: int) -> np.ndarray:
    """Where the patches of a convolution begin, in pictures of `size` x `size` pixels."""
    steps = np.arange(0, size - kernel + 1, stride)
    pixels = (np.arange(cars)[:, None, None] * size + steps[:, None]) * size + steps
    return pixels.ravel() * channels


def dense_layer(cars: int, weights: np.ndarray, bias: np.ndarray) -> Layer:
    """A layer whose patch is the whole row of a car."""
    run = weights.shape[1]
    return Layer(np.arange(cars) * run, 1, 0, run, weights, bias, -np.inf)
