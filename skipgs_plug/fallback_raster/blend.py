"""Front-to-back compositing of one image and its adjoint, one tile at a time, 16 pixels of a row as one value.

Cut-offs as in gsplat and Inria's rasterizer: alpha is at most 0.999, a contribution under 1/255 is dropped, and a
pixel is finished when the next Gaussian would bring its transmittance to 1e-4 or less.

The adjoint walks the same lists back to front. Per (tile, Gaussian) pair it needs, beside the colour, only three
sums over rows for each column, of v_sigma, v_sigma dy and v_sigma dy^2: dx is the same in every row of a tile, so
all moments that centre and conic need follow from them once per pair. Each pair writes its gradient to its own
place and `reduce_pairs` adds a Gaussian's pairs in a fixed order: no atomics, and bit-equal for any thread count.
"""

from .binning import RECORD
from .launch import FloatArray, IntArray, Worker, worker

# Gradient of a pair: centre x, y; conic a, b, c; opacity; |centre x|, |centre y|; colour.
PAIR = RECORD

# Tile `t`: its pixels, its part of the list, and per Gaussian the quadratic form in log2 units, column-wise.
_TILE = """
    const int x0 = t % tiles_x * 16, y0 = t / tiles_x * 16;
    const int rows = height - y0 < 16 ? height - y0 : 16, columns = width - x0 < 16 ? width - x0 : 16;
    const int begin = tile_start[t], end = tile_start[t + 1];
    const v16 px = lane + (x0 + 0.5f);
    const i16 inside = lane < (float)columns;
"""
_GAUSSIAN = """
        const float* r = records + 12 * tile_list[k];
        const float my = r[1] - (y0 + 0.5f);
        const v16 dx = px - r[0];
        const v16 along_x = r[5] - r[2] * dx * dx, cross = r[3] * dx;
        const int top = shortcuts & 2 ? larger(0, (int)ceilf(fmaxf(my - r[6], -1.0f))) : 0;
        const int bottom = shortcuts & 2 ? smaller(rows - 1, (int)floorf(fminf(my + r[6], 16.0f))) : rows - 1;
"""
# log2(alpha) of row `y`; log2(1/255) is the cut-off. The quadratic form of a needle may round to a negative value,
# which would lift alpha above the opacity.
_ALPHA = """
            const float dy = y - my;
            const v16 log2_alpha = vmin((v16)r[5], along_x - dy * (cross + r[4] * dy));
            const i16 above = (log2_alpha >= -7.99435344f);
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
    for (int y = 0; y < rows; ++y) {
        // The sign of T marks pixels that take no more: finished ones and those outside the image.
        T[y] = inside ? (v16)1.0f : (v16)-1.0f;
        for (int c = 0; c < D; ++c) C[y][c] = (v16)0.0f;
        stop[y] = (i16)end;
    }
    unsigned open = (1u << rows) - 1;  // rows with an unfinished pixel
    for (int k = begin; k < end && open; ++k) {
"""
        + _GAUSSIAN
        + """
        for (int y = top; y <= bottom; ++y) {
            if (!(open >> y & 1)) continue;
"""
        + _ALPHA
        + """
            i16 hit = above & (T[y] > 0.0f);
            if (!any(hit)) continue;
            const v16 alpha = vmin((v16)0.999f, exp2(log2_alpha));
            const v16 next = T[y] * (1.0f - alpha);
            const i16 finished = hit & (next <= 1e-4f);
            hit &= ~finished;
            // Selected, not multiplied by zero: a NaN colour stays in the pixels that it touches.
            const v16 weight = alpha * T[y];
            for (int c = 0; c < D; ++c) C[y][c] = hit ? C[y][c] + weight * r[8 + c] : C[y][c];
            T[y] = hit ? next : T[y];
            if (any(finished)) {
                T[y] = finished ? -T[y] : T[y];
                stop[y] = finished ? (i16)k : stop[y];
                if ((shortcuts & 4) && !any(T[y] > 0.0f)) open &= ~(1u << y);
            }
        }
    }
    int tile_end = begin;
    for (int y = 0; y < rows; ++y) {
        const long long at = (long long)(y0 + y) * width + x0;
        for (int x = 0; x < columns; ++x) {
            transmittance[at + x] = fabsf(T[y][x]);
            pixel_stop[at + x] = stop[y][x];
            for (int c = 0; c < channels; ++c) image[(at + x) * stride + channel + c] = C[y][c][x];
        }
        tile_end = larger(tile_end, __builtin_reduce_max(stop[y]));
    }
    tile_stop[t] = tile_end;
}
""",
        items="tiles_x * tiles_y",
        grain=2,
        name=f"blend_forward_{channels}",
    )
    def blend_forward(
        records: FloatArray,  # [M, RECORD]
        tile_start: IntArray,  # [tiles + 1]
        tile_list: IntArray,  # [P]
        image: FloatArray,  # out [H, W, D]
        transmittance: FloatArray,  # out [H, W], behind the last Gaussian blended
        pixel_stop: IntArray,  # out [H, W], place in tile_list at which the pixel was finished
        tile_stop: IntArray,  # out [tiles], their maximum
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
    unsigned open = 0, finished = 0;
    const int tile_end = tile_stop[t];
    for (int y = 0; y < rows; ++y) {
        const long long at = (long long)(y0 + y) * width + x0;
        v16 v_last = (v16)0.0f;
        T[y] = (v16)1.0f;
        stop[y] = (i16)tile_end;
        for (int c = 0; c < D; ++c) v[y][c] = (v16)0.0f;
        for (int x = 0; x < columns; ++x) {
            T[y][x] = transmittance[at + x];
            stop[y][x] = pixel_stop[at + x];
            v_last[x] = v_transmittance[at + x];
            for (int c = 0; c < channels; ++c) v[y][c][x] = v_image[(at + x) * stride + channel + c];
        }
        behind[y] = T[y] * v_last;
        i16 wanted = v_last != 0.0f;
        for (int c = 0; c < D; ++c) wanted |= v[y][c] != 0.0f;
        // A row without incoming gradient adds exact zeros.
        if (any(wanted) || !(shortcuts & 8)) open |= 1u << y;
        if (any(stop[y] < tile_end)) finished |= 1u << y;
    }
    const int used = open ? tile_end : begin;
    for (int k = used; k < end; ++k)
        for (int j = 0; j < 12; ++j) v_pairs[12ll * k + j] = 0.0f;

    for (int k = used - 1; k >= begin; --k) {
"""
        + _GAUSSIAN
        + """
        v16 m0 = (v16)0.0f, m1 = m0, m2 = m0, abs_x = m0, abs_y = m0, v_color[D];
        for (int c = 0; c < D; ++c) v_color[c] = m0;
        bool touched = false;
        for (int y = top; y <= bottom; ++y) {
            if (!(open >> y & 1)) continue;
"""
        + _ALPHA
        + """
            i16 hit = above & inside;
            if (finished >> y & 1) hit &= stop[y] > k;
            if (!any(hit)) continue;
            touched = true;
            const v16 full = exp2(log2_alpha);
            const v16 alpha = vmin((v16)0.999f, full);
            const v16 passed = 1.0f / (1.0f - alpha);
            const v16 before = T[y] * passed;
            v16 shade = r[8] * v[y][0];
            for (int c = 1; c < D; ++c) shade += r[8 + c] * v[y][c];
            const v16 v_alpha = before * shade - behind[y] * passed;
            const v16 weight = hit ? alpha * before : (v16)0.0f;
            // Where alpha is clamped, neither opacity nor shape moves it.
            const v16 v_sigma = (hit & (full <= 0.999f)) ? -full * v_alpha : (v16)0.0f;
            T[y] = hit ? before : T[y];
            behind[y] = hit ? behind[y] + weight * shade : behind[y];
            for (int c = 0; c < D; ++c) v_color[c] += weight * v[y][c];
            m0 += v_sigma;
            m1 += v_sigma * dy;
            m2 += v_sigma * (dy * dy);
            if (ABSGRAD) {
                abs_x += vabs(v_sigma * (2.0f * r[2] * dx + r[3] * dy));
                abs_y += vabs(v_sigma * (cross + 2.0f * r[4] * dy));
            }
        }
        float* out = v_pairs + 12ll * k;
        if (!touched) {
            for (int j = 0; j < 12; ++j) out[j] = 0.0f;
            continue;
        }
        const float ln2 = 0.693147181f;
        const float s = sum(m0), sx = sum(m0 * dx), sy = sum(m1);
        out[0] = -ln2 * (2.0f * r[2] * sx + r[3] * sy);
        out[1] = -ln2 * (r[3] * sx + 2.0f * r[4] * sy);
        out[2] = 0.5f * sum(m0 * dx * dx);
        out[3] = sum(m1 * dx);
        out[4] = 0.5f * sum(m2);
        out[5] = -s;
        out[6] = ABSGRAD ? ln2 * sum(abs_x) : 0.0f;
        out[7] = ABSGRAD ? ln2 * sum(abs_y) : 0.0f;
        for (int c = 0; c < 4; ++c) out[8 + c] = c < D ? sum(v_color[c < D ? c : 0]) : 0.0f;
    }
}
""",
        items="tiles_x * tiles_y",
        grain=2,
        name=f"blend_backward_{channels}{'_abs' if absgrad else ''}",
    )
    def blend_backward(
        records: FloatArray,  # [M, RECORD]
        tile_start: IntArray,  # [tiles + 1]
        tile_list: IntArray,  # [P]
        tile_stop: IntArray,  # [tiles]
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
    float total[12] = {};
    for (int j = pair_start[g]; j < pair_start[g + 1]; ++j) {
        // Pairs lie in the order of tiles: ask for the ones to come, also those of the next Gaussians.
        __builtin_prefetch(v_pairs + 12ll * pair_slot[smaller(j + 16, pairs - 1)]);
        const float* pair = v_pairs + 12ll * pair_slot[j];
        for (int c = 0; c < 12; ++c) total[c] += pair[c];
    }
    const float v_opacity = total[5] == 0.0f ? 0.0f : total[5] / opacities[g];
    if (channel == 0) {
        for (int c = 0; c < 2; ++c) v_means2d[2 * g + c] = total[c];
        for (int c = 0; c < 3; ++c) v_conics[3 * g + c] = total[2 + c];
        v_opacities[g] = v_opacity;
    } else {
        for (int c = 0; c < 2; ++c) v_means2d[2 * g + c] += total[c];
        for (int c = 0; c < 3; ++c) v_conics[3 * g + c] += total[2 + c];
        v_opacities[g] += v_opacity;
    }
    if (absgrad)
        for (int c = 0; c < 2; ++c) v_absolute[2 * g + c] += total[6 + c];
    for (int c = 0; c < channels; ++c) v_colors[(long long)g * stride + channel + c] = total[8 + c];
}
""",
    items="n",
    grain=512,
)
def reduce_pairs(
    pair_start: IntArray,  # [R + 1]
    pair_slot: IntArray,  # [P]
    v_pairs: FloatArray,  # [P, PAIR]
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
