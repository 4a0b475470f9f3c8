// Morphed Gaussians to splats, and their gradients through Adam, a chunk of Gaussians at a time.
#pragma once

#include "projection.h"

namespace rgbavatar::RGBAVATAR_ISA {

// ---- Frames -------------------------------------------------------------------------------------

static void fill_frames(const MorphedScene& scene, int image, int begin, int end) {
  const float* vertices = scene.vertex + int64_t(image) * scene.vertices * 3;
  float* frames = scene.frames + int64_t(image) * scene.triangles * kFrameFloats;
  for (int first = begin; first < end; first += kLanes) {
    const int lanes = end - first < kLanes ? end - first : kLanes;
    float corners[3][3][kLanes], inverse[4][kLanes], rest[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) {
      const int triangle = first + (lane < lanes ? lane : 0);
      for (int corner = 0; corner < 3; ++corner)
        for (int axis = 0; axis < 3; ++axis)
          corners[corner][axis][lane] =
              vertices[scene.triangle_vertices[int64_t(triangle) * 3 + corner] * 3 + axis];
      for (int k = 0; k < 4; ++k)
        inverse[k][lane] = scene.edges_to_frame[int64_t(triangle) * 4 + k];
      rest[lane] = scene.rest_length ? scene.rest_length[triangle] : 1.0f;
    }
    const auto vec = [](float v[3][kLanes]) __attribute__((always_inline)) {
      return Vec3<Wide>{load_wide(v[0]), load_wide(v[1]), load_wide(v[2])};
    };
    const Vec3<Wide> corner = vec(corners[0]);
    const Vec3<Wide> e1 = add_scaled(vec(corners[1]), corner, Wide(-1.0f));
    const Vec3<Wide> e2 = add_scaled(vec(corners[2]), corner, Wide(-1.0f));
    const Wide uv[4] = {load_wide(inverse[0]), load_wide(inverse[1]), load_wide(inverse[2]),
                        load_wide(inverse[3])};
    const TangentFrame<Wide> f = tangent_frame(e1, e2, uv, scene.variant);
    Wide ratio(1.0f);
    if (scene.rest_length) {
      const Vec3<Wide> area = cross(e1, e2);
      const Wide doubled = square_root(dot(area, area));
      ratio = square_root(max_of(doubled * 0.5f, Wide(1e-16f))) / load_wide(rest);
    }
    const Wide columns[kFrameFloats] = {
        f.tangent.x, f.bitangent.x, f.normal.x, f.tangent.y, f.bitangent.y, f.normal.y,
        f.tangent.z, f.bitangent.z, f.normal.z, f.quat[0],   f.quat[1],     f.quat[2],
        f.quat[3],   corner.x,      corner.y,   corner.z,    e1.x,          e1.y,
        e1.z,        e2.x,          e2.y,       e2.z,        ratio,         Wide(0.0f)};
    const OutputRows<kFrameFloats> out(frames, first, lanes);
    for (int k = 0; k < kFrameFloats; k += 4)
      store_columns(columns + k, [&](int i) { return out.data + i * kFrameFloats + k; });
  }
}

// Sixteen Gaussians' frames in an image.
struct FrameLanes {
  Vec3<Wide> row0, row1, row2;  // of the matrix
  Wide quat[4];
  Vec3<Wide> origin;
  Wide ratio;
};

// Of rows of kFrameFloats, and the second and third barycentric coordinate.
static RGBAVATAR_MEMBER FrameLanes frames_of_rows(const float* const rows[kLanes], const Wide& second,
                                                  const Wide& third) {
  Wide c[kFrameFloats];
  for (int k = 0; k < kFrameFloats; k += 4)
    load_columns([&](int i) { return rows[i] + k; }, c + k);
  const Vec3<Wide> corner = {c[13], c[14], c[15]}, e1 = {c[16], c[17], c[18]};
  const Vec3<Wide> e2 = {c[19], c[20], c[21]};
  return {{c[0], c[1], c[2]},
          {c[3], c[4], c[5]},
          {c[6], c[7], c[8]},
          {c[9], c[10], c[11], c[12]},
          add_scaled(add_scaled(corner, e1, second), e2, third),
          c[22]};
}

static RGBAVATAR_MEMBER FrameLanes load_frames(const MorphedScene& scene, int image, int first,
                                               int lanes, const Vec3<Wide>& barycentric) {
  const float* frames = scene.frames + int64_t(image) * scene.triangles * kFrameFloats;
  const float* rows[kLanes];
  for (int lane = 0; lane < kLanes; ++lane)
    rows[lane] = frames + scene.triangle_of[first + (lane < lanes ? lane : 0)] * kFrameFloats;
  return frames_of_rows(rows, barycentric.y, barycentric.z);
}

// ---- Morphing -----------------------------------------------------------------------------------

constexpr int kBlendImages = 5;  // images whose sums stay in registers together

// Sixteen numbers of an array, or fewer at its end.
static RGBAVATAR_MEMBER Wide load_some(const float* from, int count) {
  if (count >= kLanes) return load_wide(from);
  float padded[kLanes];
  for (int i = 0; i < kLanes; ++i) padded[i] = i < count ? from[i] : 0.0f;
  return load_wide(padded);
}
static RGBAVATAR_MEMBER void store_some(const Wide& value, float* to, int count) {
  if (count >= kLanes) return store(value, to);
  float padded[kLanes];
  store(value, padded);
  for (int i = 0; i < count; ++i) to[i] = padded[i];
}

// base + sum_k psi_k basis_k for kImages images; `rows` are `stride` floats apart.
template <int kImages>
static void blend_images(const float* base, const float* basis, int64_t stride, int bases,
                         const float* weights, int columns, float* out, int out_stride) {
  for (int first = 0; first < columns; first += 2 * kLanes) {
    const int low = columns - first, high = low - kLanes;
    Wide sum_low[kImages], sum_high[kImages];
    for (int b = 0; b < kImages; ++b) {
      sum_low[b] = load_some(base + first, low);
      sum_high[b] = high > 0 ? load_some(base + first + kLanes, high) : Wide(0.0f);
    }
    for (int k = 0; k < bases; ++k) {
      const float* row = basis + k * stride + first;
      __builtin_prefetch(row + 128);
      __builtin_prefetch(row + 144);
      const Wide basis_low = load_some(row, low);
      const Wide basis_high = high > 0 ? load_some(row + kLanes, high) : Wide(0.0f);
      for (int b = 0; b < kImages; ++b) {
        const Wide psi(weights[b * bases + k]);
        sum_low[b] = sum_low[b] + basis_low * psi;
        sum_high[b] = sum_high[b] + basis_high * psi;
      }
    }
    for (int b = 0; b < kImages; ++b) {  // the buffer has room for whole registers
      store(sum_low[b], out + b * out_stride + first);
      if (high > 0) store(sum_high[b], out + b * out_stride + first + kLanes);
    }
  }
}

static void blend_chunk(const MorphedScene& scene, int begin, int count, BlendScratch& scratch) {
  for (int kind = 0; kind < kMorphedKinds; ++kind) {
    const int width = kMorphedWidth[kind], out_stride = kBlendChunk * width;
    const int64_t stride = int64_t(scene.count) * width, start = int64_t(begin) * width;
    for (int image = 0; image < scene.batch;) {
      const int rest = scene.batch - image;
      const auto blend = rest >= 5   ? blend_images<5>
                         : rest == 4 ? blend_images<4>
                         : rest == 3 ? blend_images<3>
                         : rest == 2 ? blend_images<2>
                                     : blend_images<1>;
      blend(scene.base[kind] + start, scene.bases ? scene.basis[kind] + start : nullptr, stride,
            scene.bases, scene.weights + int64_t(image) * scene.bases, count * width,
            scratch.tangent[kind] + image * out_stride, out_stride);
      image += rest < kBlendImages ? rest : kBlendImages;
    }
  }
}

// Scales and opacities, which the images share. What holds no number has the opacity 0, so that it
// is not drawn: it has no place in `exponential`, which is bounded.
static void activate_chunk(const MorphedScene& scene, int begin, int count,
                           BlendScratch& scratch) {
  constexpr float kLog2E = 2.0f * C::kHalfLog2E;
  const auto exponential = [](const Wide& x) __attribute__((always_inline)) {
    const Wide p = min_of(max_of(x * kLog2E, Wide(-125.0f)), Wide(125.0f));
    return exp2_where(p == p, p);
  };
  for (int first = 0; first < count; first += kLanes) {
    const int lanes = count - first < kLanes ? count - first : kLanes;
    const Vec3<Wide> log_scale = load_vec3(scene.log_scale, begin + first, lanes);
    store(exponential(log_scale.x), scratch.scale[0] + first);
    store(exponential(log_scale.y), scratch.scale[1] + first);
    store(exponential(log_scale.z), scratch.scale[2] + first);
    const Wide logit = load_column(scene.opacity_logit, begin + first, lanes);
    const WideMask numbers = (logit == logit) & (log_scale.x == log_scale.x) &
                             (log_scale.y == log_scale.y) & (log_scale.z == log_scale.z);
    store(select(numbers, 1.0f / (1.0f + exponential(0.0f - logit)), Wide(0.0f)),
          scratch.opacity + first);
  }
}

constexpr float kColorScale = 0.28209479177387814f;  // of the zeroth spherical harmonic

// Sixteen morphed Gaussians of a frame in the world, but for their opacities.
static RGBAVATAR_MEMBER void to_world(const FrameLanes& f, const Vec3<Wide>& x,
                                      const Wide rotation[4], const Vec3<Wide>& scale,
                                      GaussianInput<Wide>& out) {
  out.mean = {dot(f.row0, x) + f.origin.x, dot(f.row1, x) + f.origin.y,
              dot(f.row2, x) + f.origin.z};
  quat_product(f.quat, rotation, out.quat);
  out.scale = scaled(scale, f.ratio);
}

static RGBAVATAR_MEMBER Vec3<Wide> color_of_feature(const Vec3<Wide>& feature) {
  return {feature.x * kColorScale + 0.5f, feature.y * kColorScale + 0.5f,
          feature.z * kColorScale + 0.5f};
}

struct WorldLanes {
  Vec3<Wide> position;  // in the tangent frame, like the rotation
  Wide rotation[4];
  GaussianInput<Wide> gaussian;
  Vec3<Wide> color;
  FrameLanes frame;
};

// Sixteen morphed Gaussians of an image, in the world. `first` counts from the chunk's begin.
static RGBAVATAR_MEMBER WorldLanes world_lanes(const MorphedScene& scene, int image, int begin,
                                               int first, int lanes, const BlendScratch& scratch) {
  const auto tangent = [&](int kind) __attribute__((always_inline)) {
    return scratch.tangent[kind] + image * kBlendChunk * kMorphedWidth[kind];
  };
  WorldLanes out;
  const Vec3<Wide> barycentric = load_vec3(scene.barycentric, begin + first, lanes);
  out.frame = load_frames(scene, image, begin + first, lanes, barycentric);
  out.position = load_vec3(tangent(0), first, kLanes);
  load_quats(tangent(1), first, kLanes, out.rotation);
  const Vec3<Wide> scale = {load_wide(scratch.scale[0] + first), load_wide(scratch.scale[1] + first),
                            load_wide(scratch.scale[2] + first)};
  to_world(out.frame, out.position, out.rotation, scale, out.gaussian);
  out.gaussian.opacity = load_wide(scratch.opacity + first);
  out.color = color_of_feature(load_vec3(tangent(2), first, kLanes));
  return out;
}

static void project_morphed(const MorphedScene& scene, const float* cameras, int begin, int end,
                            BlendScratch& scratch, const Projected* images) {
  const int count = end - begin;
  blend_chunk(scene, begin, count, scratch);
  activate_chunk(scene, begin, count, scratch);
  for (int image = 0; image < scene.batch; ++image) {
    const Camera camera = camera_from(cameras + image * kCameraFloats, scene.width, scene.height);
    for (int first = 0; first < count; first += kLanes) {
      const int lanes = count - first < kLanes ? count - first : kLanes;
      const WorldLanes world = world_lanes(scene, image, begin, first, lanes, scratch);
      project_lanes(scene.width, scene.height, camera, world.gaussian, world.color, nullptr,
                    begin + first, lanes, images[image]);
    }
  }
}

// ---- Gradients and Adam -------------------------------------------------------------------------

// Keeps what the gradient of the frames is made of; 0 for what was not drawn.
static void carry(const WorldLanes& world, const GaussianGradient<Wide>& d, const WideMask& drawn,
                  float* rows, int first, int lanes) {
  const Wide zero(0.0f);
  const GaussianInput<Wide>& g = world.gaussian;
  Wide quat[4];
  product_conjugate(d.quat, world.rotation, quat);
  const Vec3<Wide>& x = world.position;
  const Wide ratio = dot(d.scale, g.scale) / world.frame.ratio;
  const Wide columns[kCarriedFloats] = {
      d.mean.x, d.mean.y,
      d.mean.z, select(drawn, quat[0], zero),
      select(drawn, quat[1], zero), select(drawn, quat[2], zero),
      select(drawn, quat[3], zero), select(drawn, ratio, zero),
      select(drawn, x.x, zero), select(drawn, x.y, zero),
      select(drawn, x.z, zero), zero};
  const OutputRows<kCarriedFloats> out(rows, first, lanes);
  for (int k = 0; k < kCarriedFloats; k += 4)
    store_columns(columns + k, [&](int i) { return out.data + i * kCarriedFloats + k; });
}

// Turns the chunk's morphed numbers into their gradients, of all images, and sums those of scales
// and opacities.
static void differentiate_chunk(const MorphedScene& scene, const float* cameras, int begin,
                                int count, BlendScratch& scratch, const ImageSlots* images,
                                float* carried) {
  const Wide zero(0.0f);
  for (int image = 0; image < scene.batch; ++image) {
    const Camera camera = camera_from(cameras + image * kCameraFloats, scene.width, scene.height);
    for (int first = 0; first < count; first += kLanes) {
      const int lanes = count - first < kLanes ? count - first : kLanes;
      const LaneMoments moments = sum_slots(images[image], begin + first, lanes);
      const WorldLanes world = world_lanes(scene, image, begin, first, lanes, scratch);
      const GaussianGradient<Wide> d = gradient_lanes(world.gaussian, camera, moments);
      const FrameLanes& f = world.frame;
      if (carried)
        carry(world, d, moments.drawn, carried + int64_t(image) * scene.count * kCarriedFloats,
              begin + first, lanes);
      const auto of = [&](int kind) __attribute__((always_inline)) {
        return scratch.tangent[kind] + image * kBlendChunk * kMorphedWidth[kind];
      };
      const Vec3<Wide> position = add_scaled(
          add_scaled(scaled(f.row0, d.mean.x), f.row1, d.mean.y), f.row2, d.mean.z);
      store_vec3(position, of(0), first, kLanes);
      Wide rotation[4];
      conjugate_product(f.quat, d.quat, rotation);
      store_quats(rotation, of(1), first, kLanes);
      store_vec3(scaled(moments.sums.color, Wide(kColorScale)), of(2), first, kLanes);
      const GaussianInput<Wide>& g = world.gaussian;
      const Vec3<Wide> scale = {d.scale.x * g.scale.x, d.scale.y * g.scale.y,
                                d.scale.z * g.scale.z};
      put_vec3(scale, image > 0, scratch.scale_gradient, first, kLanes);
      const Wide logit = d.opacity * g.opacity * (1.0f - g.opacity);
      float* sum = scratch.opacity_gradient + first;
      store(image > 0 ? load_wide(sum) + logit : logit, sum);
    }
  }
}

static RGBAVATAR_MEMBER AdamStep adam_step(const AdamGroup& group) {
  return {group.rate, group.inverse_root, group.beta1, group.beta2, group.epsilon};
}

// Meanwhile begins to fetch the columns from `next` on.
static void adam_columns(const AdamGroup& group, int64_t start, int columns, const float* gradient,
                         int64_t next) {
  const AdamStep step = adam_step(group);
  for (int i = 0; i < columns; i += kLanes) {
    const int rest = columns - i;
    __builtin_prefetch(group.value + next + i);
    __builtin_prefetch(group.first + next + i);
    __builtin_prefetch(group.second + next + i);
    Wide value = load_some(group.value + start + i, rest);
    Wide first = load_some(group.first + start + i, rest);
    Wide second = load_some(group.second + start + i, rest);
    adam_update(load_wide(gradient + i), step, value, first, second);
    store_some(value, group.value + start + i, rest);
    store_some(first, group.first + start + i, rest);
    store_some(second, group.second + start + i, rest);
  }
}

// gradient (+)= sum_b psi_b d_b over kImages images, and sums of basis * d_b for each.
template <int kImages>
static void basis_images(const float* basis, const float* d, int d_stride, const float* weights,
                         int weight_stride, int columns, bool add, float* gradient,
                         float* weight_sums, int sum_stride) {
  Wide sums[kImages], psi[kImages];
  for (int b = 0; b < kImages; ++b) {
    sums[b] = Wide(0.0f);
    psi[b] = Wide(weights[b * weight_stride]);
  }
  for (int i = 0; i < columns; i += kLanes) {
    const Wide value = load_some(basis + i, columns - i);
    Wide g = add ? load_wide(gradient + i) : Wide(0.0f);
    for (int b = 0; b < kImages; ++b) {
      const Wide d_b = load_wide(d + b * d_stride + i);
      g = g + d_b * psi[b];
      sums[b] = sums[b] + d_b * value;
    }
    store(g, gradient + i);
  }
  for (int b = 0; b < kImages; ++b) {
    float* sum = weight_sums + b * sum_stride;
    store(load_wide(sum) + sums[b], sum);
  }
}

// The gradient of each basis, which goes into Adam at once, and of the weights.
static void update_bases(const MorphedScene& scene, int kind, int begin, int count,
                         BlendScratch& scratch, const AdamGroup* group) {
  const int width = kMorphedWidth[kind], columns = count * width, d_stride = kBlendChunk * width;
  for (int k = 0; k < scene.bases; ++k) {
    const int64_t start = (int64_t(k) * scene.count + begin) * width;
    for (int image = 0; image < scene.batch;) {
      const int rest = scene.batch - image;
      const auto visit = rest >= 5   ? basis_images<5>
                         : rest == 4 ? basis_images<4>
                         : rest == 3 ? basis_images<3>
                         : rest == 2 ? basis_images<2>
                                     : basis_images<1>;
      visit(scene.basis[kind] + start, scratch.tangent[kind] + image * d_stride, d_stride,
            scene.weights + int64_t(image) * scene.bases + k, scene.bases, columns, image > 0,
            scratch.gradient, scratch.weight_sums + (image * scene.bases + k) * kLanes,
            scene.bases * kLanes);
      image += rest < kBlendImages ? rest : kBlendImages;
    }
    if (group)
      adam_columns(*group, start, columns, scratch.gradient, start + int64_t(scene.count) * width);
  }
}

static void update_base(const MorphedScene& scene, int kind, int begin, int count,
                        BlendScratch& scratch, const AdamGroup& group) {
  const int width = kMorphedWidth[kind], columns = count * width;
  for (int i = 0; i < columns; i += kLanes) {
    Wide sum(0.0f);
    for (int image = 0; image < scene.batch; ++image)
      sum = sum + load_wide(scratch.tangent[kind] + image * kBlendChunk * width + i);
    store(sum, scratch.gradient + i);
  }
  const int64_t start = int64_t(begin) * width;
  adam_columns(group, start, columns, scratch.gradient, start + columns);
}

static void update_morphed(const MorphedScene& scene, const float* cameras, int begin, int end,
                           BlendScratch& scratch, const ImageSlots* images,
                           const MorphedOptimizer* optimizer, float* weight_gradient,
                           float* carried) {
  const int count = end - begin, weights = scene.batch * scene.bases;
  blend_chunk(scene, begin, count, scratch);
  activate_chunk(scene, begin, count, scratch);
  differentiate_chunk(scene, cameras, begin, count, scratch, images, carried);
  for (int i = 0; i < weights; ++i) store(Wide(0.0f), scratch.weight_sums + i * kLanes);
  for (int kind = 0; kind < kMorphedKinds; ++kind) {
    update_bases(scene, kind, begin, count, scratch, optimizer ? &optimizer->basis[kind] : nullptr);
    if (optimizer) update_base(scene, kind, begin, count, scratch, optimizer->base[kind]);
  }
  for (int i = 0; i < weights; ++i)
    weight_gradient[i] = sum_of(load_wide(scratch.weight_sums + i * kLanes));
  if (!optimizer) return;
  adam_columns(optimizer->log_scale, int64_t(begin) * 3, count * 3, scratch.scale_gradient,
               int64_t(end) * 3);
  adam_columns(optimizer->opacity_logit, begin, count, scratch.opacity_gradient, end);
}

}  // namespace rgbavatar::RGBAVATAR_ISA
