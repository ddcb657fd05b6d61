// Gradients of means, rotations, scales and the camera.
constexpr int RAW = 0;
const float *const opacities = nullptr, *const v_activated = nullptr;
float* const v_opacities = nullptr;
#include "lib/project_adjoint.h"
