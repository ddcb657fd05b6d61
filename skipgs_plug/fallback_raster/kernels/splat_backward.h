// Gradients of raw parameters from the sums of pairs, for one block of rows: what lies between stays in the cache.
constexpr int DENSE = 0, RAW = 1;
const int OUTER = outer;
// Kernels count rows from the first of all; what a vector reads behind the last one does not matter.
alignas(64) float center[2 * BLOCK], conic[3 * BLOCK + 16], alpha[BLOCK], color[3 * BLOCK + 16], magnitude[2 * BLOCK];
const auto counted = [=](float* p, int width) INLINE -> float* {
    return (float*)((unsigned long long)p - sizeof(float) * width * BLOCK * first);
};
float *const v_means2d = counted(center, 2), *const v_conics = counted(conic, 3);
float *const v_activated = counted(alpha, 1), *const v_colors = counted(color, 3);
float* const v_absolute = counted(magnitude, 2);
if (absgrad) clear(magnitude, 2 * BLOCK);
{
    constexpr int stride = 3, channel = 0, channels = 3;
    const int rows = n;
    const float* const opacities = activated;
    float* const v_opacities = v_activated;
#include "reduce_pairs.h"
}
for (int i = block_start[first]; i < block_start[first + 1]; ++i)
    for (int j = 0; j < 2; ++j) {
        if (with_centers) v_centers[2 * i + j] = v_means2d[2 * visible[i] + j];
        if (absgrad) absolute[2 * i + j] += v_absolute[2 * visible[i] + j];
    }
{
    constexpr int base_stride = 3, rest_offset = 0;
    float v_camera[3];
    float* const v_cameras = (float*)((unsigned long long)v_camera - sizeof(float) * 3 * first);
#include "lib/sh_adjoint.h"
}
{
    constexpr int with_depth = 0, with_pose = 0;
    const float *const v_depths = nullptr, *const v_compensations = nullptr;
    float* const v_poses = nullptr;
#include "lib/project_adjoint.h"
}
