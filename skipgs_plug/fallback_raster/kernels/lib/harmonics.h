// Real spherical harmonics up to degree 3 with the signs of 3DGS (Kerbl et al. 2023), in 16 unit directions. Products
// and sums are never fused here, so that every kernel computes the same values.
#pragma once
#include "simd.h"
static constexpr float CONSTANT_BASIS = 0.28209479177387814f;  // 1 / (2 sqrt(pi)), the basis function of degree 0
static constexpr auto harmonics = [](v16 x, v16 y, v16 z, int degree, v16* basis) INLINE {
#pragma clang fp contract(off)
    const v16 xx = x * x, yy = y * y, zz = z * z;
    basis[0] = (v16)CONSTANT_BASIS;
    if (degree > 0) {
        basis[1] = -0.4886025119029199f * y;
        basis[2] = 0.4886025119029199f * z;
        basis[3] = -0.4886025119029199f * x;
    }
    if (degree > 1) {
        basis[4] = 1.0925484305920792f * x * y;
        basis[5] = -1.0925484305920792f * y * z;
        basis[6] = 0.31539156525252005f * (2.0f * zz - xx - yy);
        basis[7] = -1.0925484305920792f * x * z;
        basis[8] = 0.5462742152960396f * (xx - yy);
    }
    if (degree > 2) {
        basis[9] = -0.5900435899266435f * y * (3.0f * xx - yy);
        basis[10] = 2.890611442640554f * x * y * z;
        basis[11] = -0.4570457994644658f * y * (4.0f * zz - xx - yy);
        basis[12] = 0.3731763325901154f * z * (2.0f * zz - 3.0f * xx - 3.0f * yy);
        basis[13] = -0.4570457994644658f * x * (4.0f * zz - xx - yy);
        basis[14] = 1.445305721320277f * z * (xx - yy);
        basis[15] = -0.5900435899266435f * x * (xx - 3.0f * yy);
    }
};
