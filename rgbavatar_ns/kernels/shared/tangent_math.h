// The formulas that carry blended Gaussians from tangent space to the world, once, like those of
// gaussian_math.h, which must be included before.
//
// A triangle with corner c and edges e1, e2 has the tangent frame M = [T B N] (paper, Alg. 1) and
// the proper rotation q_f that keeps N and lies nearest to T and B. A Gaussian at the barycentric
// coordinates (1 - b1 - b2, b1, b2) with tangent position x and rotation q has, in the world,
//   mean = M x + c + b1 e1 + b2 e2,   rotation = q_f q,
// and so dL/dx = M^T dL/dmean and dL/dq = conj(q_f) dL/drotation, because q_f has unit length.

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
