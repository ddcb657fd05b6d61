"""Front-to-back compositing of one image and its adjoint, one tile at a time, 16 pixels as one value.

Cut-offs as in gsplat and Inria's rasterizer: alpha is at most 0.999, a contribution under 1/255 is dropped, and a
pixel is finished when the next Gaussian would bring its transmittance to 1e-4 or less.

A tile is 4 x 4 blocks of 4 x 4 pixels, and a block is one value: small Gaussians fill more of a square than of a row.
Which blocks a Gaussian reaches is found for all 16 at once, from the least exponent in each. The forward pass then
takes block after block, so that its pixels stay in registers while the Gaussians pass.

The adjoint walks the same lists back to front, Gaussian after Gaussian, so that here its sums stay in registers.
It needs, beside the colour, the moments of v_sigma about the centre: of 1, dx, dy, dx^2, dx dy and dy^2. Each
(tile, Gaussian) pair writes its sums to its own place and `reduce_pairs` adds a Gaussian's pairs in a fixed order and
makes gradients of them: no atomics, and bit-equal for any thread count.
"""

from .launch import FloatArray, IntArray, Worker, worker

# Sums of a pair: the six moments; up to four channels of colour; |v_x|, |v_y|; the rest makes it a cache line.
PAIR = 16

_TILE = """
    const int x0 = t % tiles_x * 16, y0 = t / tiles_x * 16;
    const int rows = height - y0 < 16 ? height - y0 : 16, columns = width - x0 < 16 ? width - x0 : 16;
    const int begin = tile_start[t], end = tile_start[t + 1];
    v16 px[4], py[4];  // centres of the pixels of each column and row of blocks
    for (int i = 0; i < 4; ++i) px[i] = lane_x + (x0 + 4 * i + 0.5f), py[i] = lane_y + (y0 + 4 * i + 0.5f);
"""
# log2(alpha) of block `b` for the Gaussian of record `r`; log2(1/255) is the cut-off.
_ALPHA = """
                const v16 dx = px[b & 3] - r[0], dy = py[b >> 2] - r[1];
                const v16 p = r[2] * dx + r[3] * dy, w = r[4] * dy;
                const v16 log2_alpha = r[5] - p * p - w * w;
"""


def _forward(channels: int) -> Worker:
    @worker(
        f"const int D = {channels};"
        + """
for (int t = first; t < last; ++t) {
"""
        + _TILE
        + """
    v16 T[16], C[16][D];
    i16 stop[16];
    unsigned open = 0;  // blocks with an unfinished pixel
    for (int b = 0; b < 16; ++b) {
        const i16 inside = (lane_x + 4 * (b & 3) < (float)columns) & (lane_y + 4 * (b >> 2) < (float)rows);
        // The sign of T marks pixels that take no more: finished ones and those outside the image.
        T[b] = inside ? (v16)1.0f : (v16)-1.0f;
        for (int c = 0; c < D; ++c) C[b][c] = (v16)0.0f;
        stop[b] = inside ? (i16)end : (i16)begin;
        if (any(inside)) open |= 1u << b;
    }
    // First pixel of each block.
    const v16 corner_x = 4.0f * lane_x + (x0 + 0.5f), corner_y = 4.0f * lane_y + (y0 + 0.5f);
    for (int base = begin; base < end && open; base += 64) {
        unsigned long long live[16] = {};  // by block, the Gaussians of these 64 that reach it
        const int count = smaller(64, end - base);
        for (int j = 0; j < count; j += 16) {
            int reached[16] = {};
            for (int i = 0; i < 16 && j + i < count; ++i) {
                __builtin_prefetch(records + 16ll * tile_list[smaller(base + j + i + 16, end - 1)]);
                const float* r = records + 16ll * tile_list[base + j + i];
                const v16 left = corner_x - r[0], right = left + 3.0f, top = corner_y - r[1], bottom = top + 3.0f;
                // A convex function is least at the point nearest to the centre or on an edge that faces it.
                const v16 near_x = vmax(left, vmin(right, (v16)0.0f)), near_y = vmax(top, vmin(bottom, (v16)0.0f));
                const v16 at_y = vmax(top, vmin(bottom, r[13] * near_x));
                const v16 at_x = vmax(left, vmin(right, r[12] * near_y));
                const v16 p = r[2] * near_x + r[3] * at_y, w = r[4] * at_y;
                const v16 q = r[2] * at_x + r[3] * near_y, u = r[4] * near_y;
                // A little more than exact: every pixel is tested again.
                reached[i] = shortcuts & 2 ? bits(vmin(p * p + w * w, q * q + u * u) <= r[14] + 0.01f) : 65535;
                pair_blocks[base + j + i] = reached[i];
            }
            const i16 of_gaussian = *(const i16*)reached;
            for (int b = 0; b < 16; ++b) live[b] |= (unsigned long long)bits(of_gaussian & (1 << b)) << j;
        }
        for (unsigned todo = open; todo; todo &= todo - 1) {
            const int b = __builtin_ctz(todo);
            // Exponent that a Gaussian needs to count; none suffices in a finished pixel.
            v16 transmitted = T[b], color[D], least = transmitted > 0.0f ? (v16)-7.99435344f : (v16)1e30f;
            for (int c = 0; c < D; ++c) color[c] = C[b][c];
            for (unsigned long long rest = live[b]; rest; rest &= rest - 1) {
                const int k = base + __builtin_ctzll(rest);
                const float* r = records + 16ll * tile_list[k];
"""
        + _ALPHA
        + """
                const v16 alpha = vmin((v16)0.999f, exp2(log2_alpha));
                const v16 next = transmitted - alpha * transmitted;
                const i16 taken = log2_alpha >= least, finished = taken & (next <= 1e-4f);
                const i16 hit = taken & ~finished;
                // Selected, not multiplied by zero: a NaN colour stays in the pixels that it touches.
                const v16 weight = alpha * transmitted;
                for (int c = 0; c < D; ++c) color[c] = hit ? color[c] + weight * r[8 + c] : color[c];
                transmitted = hit ? next : transmitted;
                if (any(finished)) {
                    transmitted = finished ? -transmitted : transmitted;
                    least = finished ? (v16)1e30f : least;
                    stop[b] = finished ? (i16)k : stop[b];
                    if ((shortcuts & 4) && !any(transmitted > 0.0f)) {
                        open &= ~(1u << b);
                        break;
                    }
                }
            }
            T[b] = transmitted;
            for (int c = 0; c < D; ++c) C[b][c] = color[c];
        }
    }
    int tile_end = begin;
    for (int b = 0; b < 16; ++b) tile_end = larger(tile_end, __builtin_reduce_max(stop[b]));
    tile_stop[t] = tile_end;
    for (int y = 0; y < rows; ++y)
        for (int x = 0; x < columns; ++x) {
            const long long at = (long long)(y0 + y) * width + x0 + x;
            const int b = y / 4 * 4 + x / 4, l = y % 4 * 4 + x % 4;
            transmittance[at] = fabsf(T[b][l]);
            pixel_stop[at] = stop[b][l];
            for (int c = 0; c < channels; ++c) image[at * stride + channel + c] = C[b][c][l];
        }
}
""",
        items="tiles_x * tiles_y",
        grain=2,
        name=f"blend_forward_{channels}",
    )
    def blend_forward(
        records: FloatArray,  # [R, RECORD]
        tile_start: IntArray,  # [tiles + 1]
        tile_list: IntArray,  # [P]
        image: FloatArray,  # out [H, W, D]
        transmittance: FloatArray,  # out [H, W], behind the last Gaussian blended
        pixel_stop: IntArray,  # out [H, W], place in tile_list at which the pixel was finished
        tile_stop: IntArray,  # out [tiles], their maximum
        pair_blocks: IntArray,  # out [P], blocks that the pair reaches, as bits; not written beyond tile_stop
        width: int,
        height: int,
        tiles_x: int,
        tiles_y: int,
        stride: int,  # D
        channel: int,
        channels: int,
        shortcuts: int,
    ) -> None: ...

    return blend_forward


def _backward(channels: int, absgrad: bool) -> Worker:
    @worker(
        f"const int D = {channels}; const bool ABSGRAD = {int(absgrad)};"
        + """
for (int t = first; t < last; ++t) {
"""
        + _TILE
        + """
    // behind = (what lies behind the current Gaussian) . v_image, less what alpha and background receive.
    v16 T[16], behind[16], v[16][D];
    i16 stop[16];
    const int tile_end = tile_stop[t];
    for (int b = 0; b < 16; ++b) {
        T[b] = (v16)1.0f;
        behind[b] = (v16)0.0f;
        stop[b] = (i16)begin;
        for (int c = 0; c < D; ++c) v[b][c] = (v16)0.0f;
    }
    for (int y = 0; y < rows; ++y)
        for (int x = 0; x < columns; ++x) {
            const long long at = (long long)(y0 + y) * width + x0 + x;
            const int b = y / 4 * 4 + x / 4, l = y % 4 * 4 + x % 4;
            T[b][l] = transmittance[at];
            behind[b][l] = v_transmittance[at];
            stop[b][l] = pixel_stop[at];
            for (int c = 0; c < channels; ++c) v[b][c][l] = v_image[at * stride + channel + c];
        }
    unsigned open = 0;  // blocks with incoming gradient
    for (int b = 0; b < 16; ++b) {
        i16 wanted = behind[b] != 0.0f;
        for (int c = 0; c < D; ++c) wanted |= v[b][c] != 0.0f;
        behind[b] *= T[b];
        // A block without incoming gradient adds exact zeros.
        if (any(wanted) || !(shortcuts & 8)) open |= 1u << b;
    }
    const int used = open ? tile_end : begin;
    clear(v_pairs + 16ll * used, 16ll * (end - used));

    for (int k = used - 1; k >= begin; --k) {
        __builtin_prefetch(records + 16ll * tile_list[larger(k - 8, begin)]);
        const float* r = records + 16ll * tile_list[k];
        v16 m[8], abs_x = (v16)0.0f, abs_y = (v16)0.0f, v_color[D];
        for (int j = 0; j < 8; ++j) m[j] = (v16)0.0f;
        for (int c = 0; c < D; ++c) v_color[c] = (v16)0.0f;
        for (unsigned todo = pair_blocks[k] & open; todo; todo &= todo - 1) {
            const int b = __builtin_ctz(todo);
"""
        + _ALPHA
        + """
                const i16 hit = (log2_alpha >= -7.99435344f) & (stop[b] > k);
                const v16 full = exp2(log2_alpha);
                const v16 alpha = vmin((v16)0.999f, full);
                const v16 passed = 1.0f / (1.0f - alpha);
                v16 shade = r[8] * v[b][0];
                for (int c = 1; c < D; ++c) shade += r[8 + c] * v[b][c];
                // T is the transmittance behind the Gaussian, T / (1 - alpha) that before it.
                const v16 share = hit ? alpha * passed : (v16)0.0f;
                const v16 weight = share * T[b];
                // Where alpha is clamped, neither opacity nor shape moves it.
                const v16 v_sigma = hit & (full <= 0.999f) ? share * (behind[b] - T[b] * shade) : (v16)0.0f;
                T[b] += weight;
                behind[b] += hit ? weight * shade : (v16)0.0f;
                for (int c = 0; c < D; ++c) v_color[c] += weight * v[b][c];
                const v16 v_x = v_sigma * dx, v_y = v_sigma * dy;
                m[0] += v_sigma;
                m[1] += v_x;
                m[2] += v_y;
                m[3] += v_x * dx;
                m[4] += v_x * dy;
                m[5] += v_y * dy;
                if (ABSGRAD) {
                    abs_x += vabs(v_sigma * p);
                    abs_y += vabs(v_sigma * (r[3] * p + r[4] * w));
                }
        }
        float* out = v_pairs + 16ll * k;
        for (int c = 0; c < D && c < 2; ++c) m[6 + c] = v_color[c];
        *(v8*)out = sum8(m);
        for (int c = 2; c < 4; ++c) out[6 + c] = c < D ? sum(v_color[c < D ? c : 0]) : 0.0f;
        out[10] = ABSGRAD ? r[2] * sum(abs_x) : 0.0f;
        out[11] = ABSGRAD ? sum(abs_y) : 0.0f;
    }
}
""",
        items="tiles_x * tiles_y",
        grain=2,
        name=f"blend_backward_{channels}{'_abs' if absgrad else ''}",
    )
    def blend_backward(
        records: FloatArray,  # [R, RECORD]
        tile_start: IntArray,  # [tiles + 1]
        tile_list: IntArray,  # [P]
        tile_stop: IntArray,  # [tiles]
        pair_blocks: IntArray,  # [P]
        transmittance: FloatArray,  # [H, W]
        pixel_stop: IntArray,  # [H, W]
        v_image: FloatArray,  # [H, W, D]
        v_transmittance: FloatArray,  # [H, W], gradient of the final transmittance
        v_pairs: FloatArray,  # out [P, PAIR]
        width: int,
        height: int,
        tiles_x: int,
        tiles_y: int,
        stride: int,  # D
        channel: int,
        channels: int,
        shortcuts: int,
    ) -> None: ...

    return blend_backward


# One and three channels are the common cases (depth, colour); four serve colour + depth and wider features.
_WIDTHS = (1, 3, 4)
_FORWARD = {width: _forward(width) for width in _WIDTHS}
_BACKWARD = {(width, absgrad): _backward(width, absgrad) for width in _WIDTHS for absgrad in (False, True)}


def forward_worker(channels: int) -> Worker:
    """The forward kernel that fits `channels` (1 to MAX_CHANNELS) best."""
    return _FORWARD[min(width for width in _WIDTHS if width >= channels)]


def backward_worker(channels: int, absgrad: bool) -> Worker:
    """The backward kernel that fits `channels` (1 to MAX_CHANNELS) best."""
    return _BACKWARD[min(width for width in _WIDTHS if width >= channels), absgrad]


@worker(
    """
for (int g = first; g < last; ++g) {
    v16 sums = (v16)0.0f;
    for (int j = pair_start[g]; j < pair_start[g + 1]; ++j) {
        // Pairs lie in the order of tiles: ask for the ones to come, also those of the next Gaussians.
        __builtin_prefetch(v_pairs + 16ll * pair_slot[smaller(j + 16, pairs - 1)]);
        sums += load(v_pairs + 16ll * pair_slot[j]);
    }
    float total[16];
    store(total, sums);
    const float a = conics[3 * g], b = conics[3 * g + 1], c = conics[3 * g + 2];
    const float v_center[2] = {-(a * total[1] + b * total[2]), -(b * total[1] + c * total[2])};
    const float v_conic[3] = {0.5f * total[3], total[4], 0.5f * total[5]};
    const float v_opacity = total[0] == 0.0f ? 0.0f : -total[0] / opacities[g];
    const bool more = channel > 0;
    for (int j = 0; j < 2; ++j) v_means2d[2 * g + j] = v_center[j] + (more ? v_means2d[2 * g + j] : 0.0f);
    for (int j = 0; j < 3; ++j) v_conics[3 * g + j] = v_conic[j] + (more ? v_conics[3 * g + j] : 0.0f);
    v_opacities[g] = v_opacity + (more ? v_opacities[g] : 0.0f);
    for (int j = 0; j < channels; ++j) v_colors[(long long)g * stride + channel + j] = total[6 + j];
    if (absgrad)
        for (int j = 0; j < 2; ++j) v_absolute[2 * g + j] += 1.38629436f * total[10 + j];
}
""",
    items="n",
    grain=512,
)
def reduce_pairs(
    pair_start: IntArray,  # [R + 1]
    pair_slot: IntArray,  # [P]
    v_pairs: FloatArray,  # [P, PAIR]
    conics: FloatArray,  # [R, 3]
    opacities: FloatArray,  # [R]
    v_means2d: FloatArray,  # out [R, 2]; added to from the second pass over the channels on, as the next two
    v_conics: FloatArray,  # out [R, 3]
    v_opacities: FloatArray,  # out [R]
    v_absolute: FloatArray,  # out [R, 2], added to, only with absgrad
    v_colors: FloatArray,  # out [R, D]
    n: int,
    pairs: int,
    stride: int,  # D
    channel: int,
    channels: int,
    absgrad: int,
) -> None: ...
