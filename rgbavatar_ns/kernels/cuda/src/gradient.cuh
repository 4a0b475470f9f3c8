// From the slots to the gradients of Gaussians, and from these through Adam.

// Adds up what the tiles have written of a warp's Gaussians: take(sums, slot) a slot into the sums
// of a thread, join(sum, which) those of a warp. In the order of the tiles, or, of a splat that the
// warp shares, in an order that depends on nothing else either. All threads of a warp come here.
template <int kSums, class Take, class Join>
RGBAVATAR_FUNCTION void sum_tiles(const Frame& frame, const Bins& bins, int image, int gaussian,
                                  const Splat& own, float (&sums)[kSums], const Take& take,
                                  const Join& join) {
  const int lane = int(threadIdx.x) & 31;
  const uint32_t* slot_start = bins.slot_start + int64_t(image) * frame.count;
  const auto add = [&](float(&to)[kSums], int which, const Splat& s, int first, int step) {
    const int64_t start = slot_start[which];
    walk_tiles(frame, s, first, step, [&](int place, int, int) { take(to, start + place); });
  };
  if (own.drawn() && own.tiles() <= kTilesAlone) add(sums, gaussian, own, 0, 1);
  for_each_shared(splats_of(frame, bins, image), gaussian, own, [&](int which, const Splat& s) {
    float part[kSums] = {};
    add(part, which, s, lane, 32);
#pragma unroll
    for (int k = 0; k < kSums; ++k) {
      const float sum = join(part[k], k);
      if (which == gaussian) sums[k] = sum;
    }
  });
}

// The thread's splat in an image whose lists fit; one that is not drawn where they do not.
RGBAVATAR_FUNCTION Splat blended_splat(const Frame& frame, const Bins& bins, int image,
                                       int gaussian) {
  return splat_at(splats_of(frame, bins, image), frame, overflowed(bins) ? frame.count : gaussian);
}

RGBAVATAR_FUNCTION Moments<float> sum_moments(const Frame& frame, const Bins& bins, int image,
                                              int gaussian, const Splat& own, const float* slots) {
  float m[kMoments] = {};
  sum_tiles(
      frame, bins, image, gaussian, own, m,
      [&](float(&sums)[kMoments], int64_t slot) {
        for (int k = 0; k < kMoments; ++k) sums[k] += slots[slot * kMoments + k];
      },
      [](float sum, int) { return warp_sum(sum); });
  return {{m[0], m[1], m[2]}, m[3], m[4], m[5], m[6], m[7], m[8]};
}

// Sums of `average` by Gaussian. Blocks of 128 Gaussians, by images.
RGBAVATAR_KERNEL(collect, CollectArguments, kBlendThreads) {
  const int gaussian = int(blockIdx.x * blockDim.x + threadIdx.x), image = int(blockIdx.y);
  const int64_t row = int64_t(image) * a.frame.count + gaussian;
  const Splat s = blended_splat(a.frame, a.bins, image, gaussian);
  float sums[kMaxSums] = {};
  const int width = a.channels + 2;
  sum_tiles(
      a.frame, a.bins, image, gaussian, s, sums,
      [&](float(&to)[kMaxSums], int64_t slot) {
#pragma unroll
        for (int k = 0; k < kMaxSums; ++k) {
          if (k >= width) break;
          const float value = a.slots[slot * width + k];
          to[k] = k == a.channels + 1 ? fmaxf(to[k], value) : to[k] + value;
        }
      },
      [&](float sum, int k) { return k == a.channels + 1 ? warp_max(sum) : warp_sum(sum); });
  if (gaussian >= a.frame.count) return;
#pragma unroll
  for (int k = 0; k < kMaxSums; ++k) {
    if (k < a.channels && a.weighted_sum) a.weighted_sum[row * a.channels + k] = sums[k];
    if (k == a.channels && a.weight_sum) a.weight_sum[row] = sums[k];
    if (k == a.channels + 1) a.max_weight[row] = sums[k];
  }
}

// The gradient of world-space Gaussians, image by image; 0 for what was not drawn, which may hold
// anything. Blocks of 128 Gaussians, by images.
RGBAVATAR_KERNEL(project_backward, ProjectBackwardArguments, kBlendThreads) {
  const int gaussian = int(blockIdx.x * blockDim.x + threadIdx.x), image = int(blockIdx.y);
  const int64_t row = int64_t(image) * a.frame.count + gaussian;
  const Splat s = blended_splat(a.frame, a.bins, image, gaussian);
  const Moments<float> moments = sum_moments(a.frame, a.bins, image, gaussian, s, a.slots);
  if (gaussian >= a.frame.count) return;
  GaussianGradient<float> d = {};
  Vec3<float> color = {};
  if (s.drawn()) {
    const GaussianInput<float> g = world_gaussian(a.world, a.frame, image, gaussian);
    const Camera camera = camera_of(a.cameras, a.frame, image);
    d = project_backward(g, camera, project(g, camera), moments);
    color = moments.color;
  }
  put_vec3(d.mean, a.means, row);
  for (int k = 0; k < 4; ++k) a.quats[row * 4 + k] = d.quat[k];
  put_vec3(d.scale, a.scales, row);
  a.opacities[row] = d.opacity;
  put_vec3(color, a.colors, row);
  if (a.screen_offset)
    a.screen_offset[row * 2] = d.mean_x, a.screen_offset[row * 2 + 1] = d.mean_y;
}

// The gradient of one morphed Gaussian in one image. All threads of a warp come here.
RGBAVATAR_FUNCTION void morphed_gradient(const BlendBackwardArguments& a, int image, int gaussian,
                                         const Carried& c) {
  const int64_t row = int64_t(image) * a.frame.count + gaussian;
  const Splat s = blended_splat(a.frame, a.bins, image, gaussian);
  const Moments<float> moments = sum_moments(a.frame, a.bins, image, gaussian, s, a.slots);
  if (gaussian >= a.frame.count) return;
  Vec3<float> position = {}, color = {}, log_scale = {};
  float rotation[4] = {}, logit = 0.0f, carried[kCarriedFloats] = {};
  if (s.drawn()) {
    const GaussianInput<float>& g = c.gaussian;
    const Camera camera = camera_of(a.cameras, a.frame, image);
    const GaussianGradient<float> d = project_backward(g, camera, project(g, camera), moments);
    position = add_scaled(add_scaled(scaled(c.row0, d.mean.x), c.row1, d.mean.y), c.row2, d.mean.z);
    conjugate_product(c.frame_quat, d.quat, rotation);
    color = scaled(moments.color, kColorScale);
    log_scale = {d.scale.x * g.scale.x, d.scale.y * g.scale.y, d.scale.z * g.scale.z};
    logit = d.opacity * g.opacity * (1.0f - g.opacity);
    float quat[4];
    product_conjugate(d.quat, c.rotation, quat);
    const float values[kCarriedFloats] = {
        d.mean.x, d.mean.y, d.mean.z, quat[0], quat[1], quat[2], quat[3],
        dot(d.scale, g.scale) * reciprocal_of(c.ratio),
        c.position.x, c.position.y, c.position.z, 0.0f};
    for (int k = 0; k < kCarriedFloats; ++k) carried[k] = values[k];
  }
  put_vec3(position, a.position, row);
  for (int k = 0; k < 4; ++k) a.rotation[row * 4 + k] = rotation[k];
  put_vec3(color, a.color, row);
  put_vec3(log_scale, a.log_scale, row);
  a.opacity_logit[row] = logit;
  if (!a.carried) return;
  for (int k = 0; k < kCarriedFloats; ++k) a.carried[row * kCarriedFloats + k] = carried[k];
}

// Blocks of 128 Gaussians, by images.
RGBAVATAR_KERNEL(blend_backward, BlendBackwardArguments, kBlendThreads) {
  const int gaussian = int(blockIdx.x * blockDim.x + threadIdx.x), image = int(blockIdx.y);
  const int row = gaussian < a.frame.count ? gaussian : 0;
  morphed_gradient(a, image, gaussian, carry(a.blended, a.frame, image, row));
}

// From the gradients of the triangles' frames to those of their corners.
RGBAVATAR_KERNEL(frames_backward, FramesBackwardArguments, kBlendThreads) {
  const int triangle = int(blockIdx.x * blockDim.x + threadIdx.x), image = int(blockIdx.y);
  const Morphed& b = a.blended;
  if (triangle >= b.triangles) return;
  const int64_t row = int64_t(image) * b.triangles + triangle;
  const float *f = b.frames + row * kFrameFloats, *d = a.frame_gradient + row * kFrameFloats;
  const auto frame_of = [](const float* c) {
    return TangentFrame<float>{
        {c[0], c[3], c[6]}, {c[1], c[4], c[7]}, {c[2], c[5], c[8]}, {c[9], c[10], c[11], c[12]}};
  };
  const Vec3<float> e1 = {f[16], f[17], f[18]}, e2 = {f[19], f[20], f[21]};
  Vec3<float> corner = {d[13], d[14], d[15]}, first = {d[16], d[17], d[18]};
  Vec3<float> second = {d[19], d[20], d[21]};
  tangent_frame_backward(e1, e2, b.edges_to_frame + int64_t(triangle) * 4, b.variant, frame_of(f),
                         frame_of(d), first, second);
  if (b.rest_length) {  // the ratio is the root of |e1 x e2|, over a constant
    const Vec3<float> area = cross(e1, e2);
    const float square = dot(area, area);
    if (square > 4e-32f) {
      const Vec3<float> d_area = scaled(area, d[22] * f[22] * 0.5f / square);
      first = add_scaled(first, cross(e2, d_area), 1.0f);
      second = add_scaled(second, cross(d_area, e1), 1.0f);
    }
  }
  corner = add_scaled(add_scaled(corner, first, -1.0f), second, -1.0f);
  put_vec3(corner, a.corner_gradient, row * 3);
  put_vec3(first, a.corner_gradient, row * 3 + 1);
  put_vec3(second, a.corner_gradient, row * 3 + 2);
}
