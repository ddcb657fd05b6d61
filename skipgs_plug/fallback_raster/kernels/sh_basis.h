// Real spherical harmonics up to degree 3 with the signs of 3DGS (Kerbl et al. 2023), in the unit direction x, y, z
// from the camera to a Gaussian; norm * shrink is what the distance was multiplied with.
static constexpr auto harmonics = [](const float* mean, const float* camera, int degree, float* basis, float& x,
                                     float& y, float& z, float& norm, float& shrink) INLINE {
    const float dx = mean[0] - camera[0], dy = mean[1] - camera[1], dz = mean[2] - camera[2];
    // Scaled by the longest side first: the square of a tiny or huge distance would leave float's range.
    const float longest = fmaxf(fabsf(dx), fmaxf(fabsf(dy), fabsf(dz)));
    shrink = longest > 1e-30f ? 1.0f / longest : 0.0f;
    x = dx * shrink, y = dy * shrink, z = dz * shrink;
    float square;
    {
        // Fused by hand, so that both passes get one direction: Clang's choice depends on what stands around.
#pragma clang fp contract(off)
        square = __builtin_elementwise_fma(x, x, y * y) + z * z;
    }
    norm = 1.0f / sqrtf(fmaxf(square, 1e-30f));
    x *= norm, y *= norm, z *= norm;
    const float xx = x * x, yy = y * y, zz = z * z;
    basis[0] = 0.28209479177387814f;
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
