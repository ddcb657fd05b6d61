// Gradients of means, all bands and the camera's centre.
constexpr int OUTER = 0;
float *const factor_directions = nullptr, *const factor_colors = nullptr;
#include "lib/sh_adjoint.h"
