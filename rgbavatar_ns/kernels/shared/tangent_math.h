// The formulas that carry morphed Gaussians from tangent space to the world, once, like those of
// gaussian_math.h, which must be included before.
//
// A triangle with corner c and edges e1, e2 has the tangent frame M = [T B N] (paper, Alg. 1) and
// the proper rotation q_f that keeps N and lies nearest to T and B. A Gaussian at the barycentric
// coordinates (1 - b1 - b2, b1, b2) with tangent position x and rotation q has, in the world,
//   mean = M x + c + b1 e1 + b2 e2,   rotation = q_f q,
// and so dL/dx = M^T dL/dmean and dL/dq = conj(q_f) dL/drotation, because q_f has unit length.
// The frame's own gradient is dL/dM = dL/dmean x^T and dL/dq_f = dL/drotation conj(q).

enum TangentVariant { kNormalizedFrame = 0, kRawFrame = 1, kOrthonormalFrame = 2 };

template <class F>
struct TangentFrame {
  Vec3<F> tangent, bitangent, normal;
  F quat[4];
};

template <class F>
RGBAVATAR_FUNCTION Vec3<F> scaled_to_one(const Vec3<F>& a) {
  return scaled(a, inverse_root_of(dot(a, a)));
}

// Unit quaternion (w x y z) of the rotation with columns u, v, n. Of the four components the one
// that is surely not small is found first (Day 2015).
template <class F>
RGBAVATAR_FUNCTION void quat_of_columns(const Vec3<F>& u, const Vec3<F>& v, const Vec3<F>& n,
                                        F out[4]) {
  const F zero(0.0f), one(1.0f);
  const auto z_up = n.z >= zero, x_wins = u.x > v.y, not_z = u.x >= zero - v.y;
  // Signs of the trace's terms: w + + +, x + - -, y - + -, z - - +.
  const F sign_x = select(z_up, select(not_z, one, zero - one), select(x_wins, one, zero - one));
  const F sign_y = select(z_up, select(not_z, one, zero - one), select(x_wins, zero - one, one));
  const F sign_z = select(z_up, one, zero - one);
  const F square = one + sign_x * u.x + sign_y * v.y + sign_z * n.z;
  const F factor = 0.5f * inverse_root_of(square);
  const F wx = v.z - n.y, wy = n.x - u.z, wz = u.y - v.x;
  const F xy = v.x + u.y, xz = n.x + u.z, yz = n.y + v.z;
  const auto pick = [&](const F& w, const F& x, const F& y, const F& z) {
    return select(z_up, select(not_z, w, z), select(x_wins, x, y)) * factor;
  };
  out[0] = pick(square, wx, wy, wz);
  out[1] = pick(wx, square, xy, xz);
  out[2] = pick(wy, xy, square, yz);
  out[3] = pick(wz, xz, yz, square);
}

// The frame of a triangle with these edges; `inverse` gives T and B from the edges (two rows).
// Triangles without area take the world's axes for edges.
template <class F>
RGBAVATAR_FUNCTION TangentFrame<F> tangent_frame(Vec3<F> first, Vec3<F> second, const F inverse[4],
                                                 int variant) {
  const F zero(0.0f), one(1.0f);
  const Vec3<F> area = cross(first, second);
  const auto wide = dot(area, area) > 1e-10f * dot(first, first) * dot(second, second) + 1e-30f;
  first = {select(wide, first.x, one), select(wide, first.y, zero), select(wide, first.z, zero)};
  second = {select(wide, second.x, zero), select(wide, second.y, one),
            select(wide, second.z, zero)};
  TangentFrame<F> out;
  out.normal = scaled_to_one(cross(first, second));
  out.tangent = add_scaled(scaled(first, inverse[0]), second, inverse[1]);
  out.bitangent = add_scaled(scaled(first, inverse[2]), second, inverse[3]);
  if (variant != kRawFrame) out.tangent = scaled_to_one(out.tangent);
  if (variant == kNormalizedFrame) out.bitangent = scaled_to_one(out.bitangent);
  if (variant == kOrthonormalFrame) out.bitangent = cross(out.normal, out.tangent);
  // Turned back by 90 degrees, B is a second wish for T's direction; where the map is mirrored, its
  // opposite is.
  const Vec3<F> turned = cross(out.bitangent, out.normal);
  const F sign = select(dot(turned, out.tangent) >= zero, one, zero - one);
  const Vec3<F> wished = add_scaled(out.tangent, turned, sign);
  const F off_plane = dot(wished, out.normal);
  const Vec3<F> along_u = scaled_to_one(add_scaled(wished, out.normal, zero - off_plane));
  quat_of_columns(along_u, cross(out.normal, along_u), out.normal, out.quat);
  return out;
}

// The Hamilton product a b of quaternions w x y z.
template <class F>
RGBAVATAR_FUNCTION void quat_product(const F a[4], const F b[4], F out[4]) {
  out[0] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3];
  out[1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2];
  out[2] = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1];
  out[3] = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0];
}

// conj(a) b.
template <class F>
RGBAVATAR_FUNCTION void conjugate_product(const F a[4], const F b[4], F out[4]) {
  const F zero(0.0f);
  const F conjugate[4] = {a[0], zero - a[1], zero - a[2], zero - a[3]};
  quat_product(conjugate, b, out);
}

// a conj(b).
template <class F>
RGBAVATAR_FUNCTION void product_conjugate(const F a[4], const F b[4], F out[4]) {
  const F zero(0.0f);
  const F conjugate[4] = {b[0], zero - b[1], zero - b[2], zero - b[3]};
  quat_product(a, conjugate, out);
}

// The gradient of a by that of a / |a|; `unit` is the latter.
template <class F>
RGBAVATAR_FUNCTION Vec3<F> scaled_to_one_backward(const Vec3<F>& a, const Vec3<F>& unit,
                                                  const Vec3<F>& gradient) {
  const Vec3<F> across = add_scaled(gradient, unit, F(0.0f) - dot(unit, gradient));
  return scaled(across, inverse_root_of(dot(a, a)));
}

// Adds to the gradients of the edges what comes from that of `tangent_frame`; nothing from a
// triangle without area, whose frame does not hang on them.
template <class F>
RGBAVATAR_FUNCTION void tangent_frame_backward(const Vec3<F>& first, const Vec3<F>& second,
                                               const F inverse[4], int variant,
                                               const TangentFrame<F>& frame,
                                               const TangentFrame<F>& gradient, Vec3<F>& d_first,
                                               Vec3<F>& d_second) {
  const F zero(0.0f), one(1.0f);
  const Vec3<F> area = cross(first, second);
  const auto wide = dot(area, area) > 1e-10f * dot(first, first) * dot(second, second) + 1e-30f;
  const Vec3<F>&t = frame.tangent, &b = frame.bitangent, &n = frame.normal;
  Vec3<F> d_t = gradient.tangent, d_b = gradient.bitangent, d_n = gradient.normal;
  // The rotation with columns u, v, n turns by w: dL/dw = Im(dL/dq conj(q)) / 2, and
  // w = (du . v) n - (dn . v) u + (dn . u) v.
  const Vec3<F> turned = cross(b, n);
  const F sign = select(dot(turned, t) >= zero, one, zero - one);
  const Vec3<F> wished = add_scaled(t, turned, sign);
  const F off_plane = dot(wished, n);
  const Vec3<F> along = add_scaled(wished, n, zero - off_plane);
  const F inverse_length = inverse_root_of(dot(along, along));
  const Vec3<F> u = scaled(along, inverse_length), v = cross(n, u);
  F doubled[4];
  product_conjugate(gradient.quat, frame.quat, doubled);
  const Vec3<F> turn = scaled(Vec3<F>{doubled[1], doubled[2], doubled[3]}, 0.5f);
  const F about_n = dot(turn, n) * inverse_length;
  d_n = add_scaled(d_n, v, zero - dot(turn, u) - off_plane * about_n);
  d_n = add_scaled(d_n, u, dot(turn, v));
  const Vec3<F> d_wished = scaled(v, about_n), d_turned = scaled(d_wished, sign);
  d_t = add_scaled(d_t, d_wished, one);
  d_b = add_scaled(d_b, cross(n, d_turned), one);
  d_n = add_scaled(d_n, cross(d_turned, b), one);
  if (variant == kOrthonormalFrame) {  // b = n x t
    d_n = add_scaled(d_n, cross(t, d_b), one);
    d_t = add_scaled(d_t, cross(d_b, n), one);
    d_b = {zero, zero, zero};
  }
  if (variant != kRawFrame) {
    const Vec3<F> along_u = add_scaled(scaled(first, inverse[0]), second, inverse[1]);
    d_t = scaled_to_one_backward(along_u, t, d_t);
  }
  if (variant == kNormalizedFrame) {
    const Vec3<F> along_v = add_scaled(scaled(first, inverse[2]), second, inverse[3]);
    d_b = scaled_to_one_backward(along_v, b, d_b);
  }
  const Vec3<F> d_area = scaled_to_one_backward(area, n, d_n);
  const auto add = [&](Vec3<F>& sum, const Vec3<F>& part) {
    sum = {sum.x + select(wide, part.x, zero), sum.y + select(wide, part.y, zero),
           sum.z + select(wide, part.z, zero)};
  };
  add(d_first, add_scaled(add_scaled(cross(second, d_area), d_t, inverse[0]), d_b, inverse[2]));
  add(d_second, add_scaled(add_scaled(cross(d_area, first), d_t, inverse[1]), d_b, inverse[3]));
}

// Adam (Kingma and Ba 2015) with both bias corrections folded into the numbers of a step:
// rate = lr / (1 - beta1^t), inverse_root = 1 / sqrt(1 - beta2^t).
struct AdamStep {
  float rate, inverse_root, beta1, beta2, epsilon;
};

template <class F>
RGBAVATAR_FUNCTION void adam_update(const F& gradient, const AdamStep& a, F& value, F& first,
                                    F& second) {
  first = first + (gradient - first) * (1.0f - a.beta1);
  second = second * a.beta2 + gradient * gradient * (1.0f - a.beta2);
  // Below this the root is nothing beside any epsilon; the estimate needs a normal number.
  const F floor = max_of(second, F(1e-37f));
  const F root = floor * inverse_root_of(floor);
  value = value - first * a.rate * reciprocal_of(root * a.inverse_root + a.epsilon);
}
