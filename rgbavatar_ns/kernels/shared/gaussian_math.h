// The formulas of the rasterizer, once, for both compiled backends: kernels/cpu and kernels/cuda.
//
// F is a floating-point type: float (in CUDA a thread's), or a vector of lanes that each hold
// another Gaussian (projection) or another pixel (blending). It needs + - * /, comparisons that give
// a mask, and select(mask, a, b), min_of, max_of, square_root, inverse_root_of, log2_of and
// reciprocal_of.
// Define RGBAVATAR_FUNCTION before including, e.g. as "__device__ __forceinline__", and include
// inside a namespace of its own for every instruction set.
//
// ---- Projection (EWA splatting) ---------------------------------------------------------------
// p = W m + t is the mean in camera space, sx = fx/z, sy = fy/z, u = x/z, v = y/z (clamped).
// With A = W R(q) diag(s), whose rows are a0 a1 a2, the image of the Gaussian's square root is
//   u0 = sx (a0 - u a2),   u1 = sy (a1 - v a2),   cov = [u0.u0  u0.u1; u0.u1  u1.u1] + d I.
// Its determinant is taken as |u0 x u1|^2 + d (u0.u0 + u1.u1) + d^2 (Lagrange's identity), which
// has no cancellation. With k = log2(e)/2 and the conic Q = cov^-1, alpha = exp2(p) for
//   p = log2(o) + qa dx^2 + qb dx dy + qc dy^2,   qa = -k Q00, qb = -2 k Q01, qc = -k Q11.
//
// ---- Blending, forward ------------------------------------------------------------------------
// w = alpha T; colour += w c; T -= w. The image is colour + T_end background, its alpha 1 - T_end.
//
// ---- Blending, backward -----------------------------------------------------------------------
// With g = dL/dimage, h = dL/dalpha, the part of the loss that is linear in the pixel is
//   S = sum_j w_j (g.c_j) + T_end (g.background - h)
// and, because 1 - alpha_i divides every later w and T_end,
//   dL/dalpha_i = T_i (g.c_i) - rem_i / (1 - alpha_i),   rem_i = S - sum_{j<=i} w_j (g.c_j).
// S = g.image - h (1 - alpha) is known from the forward result, so one pass front to back with the
// scalar rem suffices. Where the weights were kept, one pass back to front does it without dividing:
// with behind_i = rem_i / T_i+1, what Gaussian i lets through, beginning with g.background - h,
//   alpha_i dL/dalpha_i = w_i (g.c_i - behind_i),  behind_i-1 = behind_i + alpha_i (g.c_i - behind_i).
// A Gaussian gets nine sums over its pixels: w g (3), and G = dL/dp times
// {1, dx, dy, dx^2, dx dy, dy^2}, where dL/dp = ln 2 alpha dL/dalpha.
//
// ---- Projection, backward ---------------------------------------------------------------------
// d mean = -(2 qa Gx + qb Gy, qb Gx + 2 qc Gy);   d o = G1 / (o ln 2).
// p = ... - k d^T Q d gives dL/dQ = -k M with M = [Gxx Gxy; Gxy Gyy]; dQ = -Q dcov Q gives
// dL/dcov = k Q M Q =: E, and cov = U U^T + d I gives dL/dU = 2 E U with rows v0, v1. Then
//   d a0 = sx v0,  d a1 = sy v1,  d a2 = -(sx u v0 + sy v v1),
//   d u = -sx v0.a2,  d v = -sy v1.a2   (0 where clamped),
//   d z gets -(v0.u0 + v1.u1)/z from sx and sy, and -(u du + v dv)/z from u and v.
// A = W R diag(s): with B = W^T dA, ds_j = sum_i B_ij R_ij and dR_ij = B_ij s_j.

struct BlendingConstants {
  static constexpr float kNearPlane = 0.01f;
  static constexpr float kDilation = 0.3f;
  static constexpr float kMaxAlpha = 0.999f;
  static constexpr float kMinAlpha = 1.0f / 255.0f;
  static constexpr float kLog2MinAlpha = -7.994353436858858f;
  static constexpr float kMinTransmittance = 1e-4f;
  static constexpr float kFrustumMargin = 0.3f;
  static constexpr float kMinQuatNorm = 1e-12f;
  static constexpr float kHalfLog2E = 0.7213475204444817f;
  static constexpr float kLn2 = 0.6931471805599453f;
  static constexpr int32_t kUnfilmed = 0x00fd01fe;  // RGBA from the lowest byte on
};

template <class F>
struct Vec3 {
  F x, y, z;
};

template <class F>
RGBAVATAR_FUNCTION F dot(const Vec3<F>& a, const Vec3<F>& b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}

template <class F>
RGBAVATAR_FUNCTION Vec3<F> cross(const Vec3<F>& a, const Vec3<F>& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

template <class F, class S>
RGBAVATAR_FUNCTION Vec3<F> scaled(const Vec3<F>& a, const S& s) {
  return {a.x * s, a.y * s, a.z * s};
}

template <class F, class S>
RGBAVATAR_FUNCTION Vec3<F> add_scaled(const Vec3<F>& a, const Vec3<F>& b, const S& s) {
  return {a.x + b.x * s, a.y + b.y * s, a.z + b.z * s};
}

// A pinhole camera: rows of the world-to-camera rotation, and where x/z and y/z are clamped.
struct Camera {
  Vec3<float> row0, row1, row2, translation;
  float fx, fy, cx, cy;
  float min_u, max_u, min_v, max_v;
};

RGBAVATAR_FUNCTION Camera camera_of_arrays(const float* world_to_camera, const float* focal_px,
                                           const float* principal_point_px, int width,
                                           int height) {
  const float* m = world_to_camera;
  Camera c;
  c.row0 = {m[0], m[1], m[2]}, c.row1 = {m[4], m[5], m[6]}, c.row2 = {m[8], m[9], m[10]};
  c.translation = {m[3], m[7], m[11]};
  c.fx = focal_px[0], c.fy = focal_px[1];
  c.cx = principal_point_px[0], c.cy = principal_point_px[1];
  const float margin_u = BlendingConstants::kFrustumMargin * 0.5f * width / c.fx;
  const float margin_v = BlendingConstants::kFrustumMargin * 0.5f * height / c.fy;
  c.min_u = -c.cx / c.fx - margin_u, c.max_u = (width - c.cx) / c.fx + margin_u;
  c.min_v = -c.cy / c.fy - margin_v, c.max_v = (height - c.cy) / c.fy + margin_v;
  return c;
}

template <class F>
struct GaussianInput {
  Vec3<F> mean;
  F quat[4];  // w x y z, not normalised
  Vec3<F> scale;
  F opacity;
};

// Everything the backward pass needs again.
template <class F>
struct Projection {
  Vec3<F> p;                   // mean in camera space
  F inverse_z, u, v;           // u and v clamped
  F slope_x, slope_y;          // x/z and y/z, not clamped
  F inverse_norm;              // of the quaternion
  F w, x, y, z;                // normalised quaternion
  Vec3<F> r0, r1, r2;          // rows of R(q)
  Vec3<F> a0, a1, a2, u0, u1;  // see above
  F conic00, conic01, conic11;
  F cov00, cov11, determinant;
  F mean_x, mean_y;
};

template <class F>
RGBAVATAR_FUNCTION Vec3<F> factor_row(const Vec3<float>& row, const Projection<F>& q,
                                      const Vec3<F>& scale) {
  const Vec3<F> r = {q.r0.x * row.x + q.r1.x * row.y + q.r2.x * row.z,
                     q.r0.y * row.x + q.r1.y * row.y + q.r2.y * row.z,
                     q.r0.z * row.x + q.r1.z * row.y + q.r2.z * row.z};
  return {r.x * scale.x, r.y * scale.y, r.z * scale.z};
}

template <class F>
RGBAVATAR_FUNCTION F transform_row(const Vec3<float>& row, float offset, const Vec3<F>& m) {
  return m.x * row.x + m.y * row.y + m.z * row.z + offset;
}

template <class F>
RGBAVATAR_FUNCTION void rotate(const F quat[4], Projection<F>& q) {
  const F norm2 = quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3];
  q.inverse_norm = inverse_root_of(norm2);
  const F w = quat[0] * q.inverse_norm, x = quat[1] * q.inverse_norm;
  const F y = quat[2] * q.inverse_norm, z = quat[3] * q.inverse_norm;
  q.w = w, q.x = x, q.y = y, q.z = z;
  q.r0 = {1.0f - 2.0f * (y * y + z * z), 2.0f * (x * y - w * z), 2.0f * (x * z + w * y)};
  q.r1 = {2.0f * (x * y + w * z), 1.0f - 2.0f * (x * x + z * z), 2.0f * (y * z - w * x)};
  q.r2 = {2.0f * (x * z - w * y), 2.0f * (y * z + w * x), 1.0f - 2.0f * (x * x + y * y)};
}

template <class F>
RGBAVATAR_FUNCTION Projection<F> project(const GaussianInput<F>& g, const Camera& c) {
  Projection<F> q;
  q.p = {transform_row(c.row0, c.translation.x, g.mean),
         transform_row(c.row1, c.translation.y, g.mean),
         transform_row(c.row2, c.translation.z, g.mean)};
  q.inverse_z = reciprocal_of(q.p.z);
  q.slope_x = q.p.x * q.inverse_z;
  q.slope_y = q.p.y * q.inverse_z;
  q.mean_x = q.slope_x * c.fx + c.cx;
  q.mean_y = q.slope_y * c.fy + c.cy;
  q.u = min_of(max_of(q.slope_x, F(c.min_u)), F(c.max_u));
  q.v = min_of(max_of(q.slope_y, F(c.min_v)), F(c.max_v));
  rotate(g.quat, q);
  q.a0 = factor_row(c.row0, q, g.scale);
  q.a1 = factor_row(c.row1, q, g.scale);
  q.a2 = factor_row(c.row2, q, g.scale);
  q.u0 = scaled(add_scaled(q.a0, q.a2, F(0.0f) - q.u), q.inverse_z * c.fx);
  q.u1 = scaled(add_scaled(q.a1, q.a2, F(0.0f) - q.v), q.inverse_z * c.fy);
  constexpr float d = BlendingConstants::kDilation;
  const F s00 = dot(q.u0, q.u0), s01 = dot(q.u0, q.u1), s11 = dot(q.u1, q.u1);
  const Vec3<F> n = cross(q.u0, q.u1);
  q.cov00 = s00 + d, q.cov11 = s11 + d;
  q.determinant = dot(n, n) + d * (s00 + s11) + d * d;
  const F inverse = reciprocal_of(q.determinant);
  q.conic00 = q.cov11 * inverse;
  q.conic01 = F(0.0f) - s01 * inverse;
  q.conic11 = q.cov00 * inverse;
  return q;
}

// Moves the mean in the image by so many pixels; depth and shape stay as they were projected.
template <class F>
RGBAVATAR_FUNCTION void move_mean(const F& x_px, const F& y_px, Projection<F>& q) {
  q.mean_x = q.mean_x + x_px;
  q.mean_y = q.mean_y + y_px;
}

// Whether the Gaussian can be drawn: finite, oriented, in front of the camera.
template <class F>
RGBAVATAR_FUNCTION auto is_drawable(const GaussianInput<F>& g, const Vec3<F>& color,
                                    const Projection<F>& q) {
  using C = BlendingConstants;
  // x * 0 is NaN for every x that is not finite.
  const F zero = (g.opacity + q.p.z) * 0.0f + color.x * 0.0f + color.y * 0.0f + color.z * 0.0f +
                 (q.mean_x + q.mean_y) * 0.0f + q.determinant * 0.0f +
                 (q.conic00 + q.conic01 + q.conic11) * 0.0f;
  const F limit = F(1.0f / C::kMinQuatNorm);
  return (zero >= F(0.0f)) & (q.p.z >= F(C::kNearPlane)) & (q.determinant > F(0.0f)) &
         (q.inverse_norm <= limit) & (q.inverse_norm > F(0.0f)) & (g.opacity >= F(C::kMinAlpha));
}

// Where alpha falls to the cut: -k d^T Q d = log2(min alpha / o), an ellipse d^T cov^-1 d = reach
// of half-widths sqrt(reach cov) = sqrt(2 ln(o / min alpha) cov).
template <class F>
struct Extent {
  F reach, half_x, half_y;
};

template <class F>
RGBAVATAR_FUNCTION Extent<F> extent_of(const Projection<F>& q, const F& log2_opacity) {
  using C = BlendingConstants;
  const F reach = (log2_opacity - C::kLog2MinAlpha) * (2.0f * C::kLn2);
  return {reach, square_root(reach * q.cov00), square_root(reach * q.cov11)};
}

// Log2 of the alpha at offset (dx, dy) from the mean, before cut and cap.
template <class F>
RGBAVATAR_FUNCTION F log2_alpha(const F& dx, const F& dy, const F& log2_opacity, const F& qa,
                                const F& qb, const F& qc) {
  return dx * (dx * qa + dy * qb) + (dy * (dy * qc) + log2_opacity);
}

// The nine sums over pixels that the blending's backward pass gives for one Gaussian.
template <class F>
struct Moments {
  Vec3<F> color;
  F one, x, y, xx, xy, yy;
};

template <class F>
struct GaussianGradient {
  Vec3<F> mean;
  F quat[4];
  Vec3<F> scale;
  F opacity;
  F mean_x, mean_y;  // of the mean in the image, in pixels
};

template <class F>
RGBAVATAR_FUNCTION void rotation_gradient(const Projection<F>& q, const Vec3<F>& d0,
                                          const Vec3<F>& d1, const Vec3<F>& d2, F out[4]) {
  // R(q) written out and differentiated by each component of the unit quaternion.
  const F w = q.w, x = q.x, y = q.y, z = q.z;
  const F dw = 2.0f * (x * (d2.y - d1.z) + y * (d0.z - d2.x) + z * (d1.x - d0.y));
  const F dx = 2.0f * (y * (d0.y + d1.x) + z * (d0.z + d2.x) + w * (d2.y - d1.z)) -
               4.0f * x * (d1.y + d2.z);
  const F dy = 2.0f * (x * (d0.y + d1.x) + z * (d1.z + d2.y) + w * (d0.z - d2.x)) -
               4.0f * y * (d0.x + d2.z);
  const F dz = 2.0f * (x * (d0.z + d2.x) + y * (d1.z + d2.y) + w * (d1.x - d0.y)) -
               4.0f * z * (d0.x + d1.y);
  // Normalisation lets only the part across the quaternion through.
  const F along = w * dw + x * dx + y * dy + z * dz;
  out[0] = (dw - along * w) * q.inverse_norm;
  out[1] = (dx - along * x) * q.inverse_norm;
  out[2] = (dy - along * y) * q.inverse_norm;
  out[3] = (dz - along * z) * q.inverse_norm;
}

template <class F>
RGBAVATAR_FUNCTION Vec3<F> camera_mean_gradient(const Projection<F>& q, const Camera& c,
                                                const F& mean_x, const F& mean_y,
                                                const Vec3<F>& v0, const Vec3<F>& v1) {
  const F sx = q.inverse_z * c.fx, sy = q.inverse_z * c.fy;
  const F zero = F(0.0f);
  const F du = select(q.u == q.slope_x, zero - sx * dot(v0, q.a2), zero);
  const F dv = select(q.v == q.slope_y, zero - sy * dot(v1, q.a2), zero);
  const F slope_x = mean_x * c.fx + du, slope_y = mean_y * c.fy + dv;
  const F dz = zero - (dot(v0, q.u0) + dot(v1, q.u1) + slope_x * q.slope_x + slope_y * q.slope_y);
  return {slope_x * q.inverse_z, slope_y * q.inverse_z, dz * q.inverse_z};
}

template <class F>
RGBAVATAR_FUNCTION GaussianGradient<F> project_backward(const GaussianInput<F>& g, const Camera& c,
                                                        const Projection<F>& q,
                                                        const Moments<F>& m) {
  GaussianGradient<F> out;
  out.opacity = m.one / (g.opacity * BlendingConstants::kLn2);
  constexpr float k2 = 2.0f * BlendingConstants::kHalfLog2E;
  out.mean_x = k2 * (q.conic00 * m.x + q.conic01 * m.y);
  out.mean_y = k2 * (q.conic01 * m.x + q.conic11 * m.y);
  // E = k Q M Q, then v = 2 E U.
  const F qm00 = q.conic00 * m.xx + q.conic01 * m.xy, qm01 = q.conic00 * m.xy + q.conic01 * m.yy;
  const F qm10 = q.conic01 * m.xx + q.conic11 * m.xy, qm11 = q.conic01 * m.xy + q.conic11 * m.yy;
  const F e00 = k2 * (qm00 * q.conic00 + qm01 * q.conic01);
  const F e01 = k2 * (qm00 * q.conic01 + qm01 * q.conic11);
  const F e11 = k2 * (qm10 * q.conic01 + qm11 * q.conic11);
  const Vec3<F> v0 = add_scaled(scaled(q.u0, e00), q.u1, e01);
  const Vec3<F> v1 = add_scaled(scaled(q.u0, e01), q.u1, e11);
  const Vec3<F> dp = camera_mean_gradient(q, c, out.mean_x, out.mean_y, v0, v1);
  out.mean = add_scaled(
      add_scaled(Vec3<F>{dp.x * c.row0.x, dp.x * c.row0.y, dp.x * c.row0.z},
                 Vec3<F>{F(c.row1.x), F(c.row1.y), F(c.row1.z)}, dp.y),
      Vec3<F>{F(c.row2.x), F(c.row2.y), F(c.row2.z)}, dp.z);
  const F sx = q.inverse_z * c.fx, sy = q.inverse_z * c.fy, zero = F(0.0f);
  const Vec3<F> d0 = scaled(v0, sx), d1 = scaled(v1, sy);
  const Vec3<F> d2 = add_scaled(scaled(d0, zero - q.u), d1, zero - q.v);
  // Rows of B = W^T dA.
  const Vec3<F> b0 = add_scaled(add_scaled(scaled(d0, c.row0.x), d1, c.row1.x), d2, c.row2.x);
  const Vec3<F> b1 = add_scaled(add_scaled(scaled(d0, c.row0.y), d1, c.row1.y), d2, c.row2.y);
  const Vec3<F> b2 = add_scaled(add_scaled(scaled(d0, c.row0.z), d1, c.row1.z), d2, c.row2.z);
  out.scale = {b0.x * q.r0.x + b1.x * q.r1.x + b2.x * q.r2.x,
               b0.y * q.r0.y + b1.y * q.r1.y + b2.y * q.r2.y,
               b0.z * q.r0.z + b1.z * q.r1.z + b2.z * q.r2.z};
  const Vec3<F>& s = g.scale;
  rotation_gradient(q, Vec3<F>{b0.x * s.x, b0.y * s.y, b0.z * s.z},
                    Vec3<F>{b1.x * s.x, b1.y * s.y, b1.z * s.z},
                    Vec3<F>{b2.x * s.x, b2.y * s.y, b2.z * s.z}, out.quat);
  return out;
}
