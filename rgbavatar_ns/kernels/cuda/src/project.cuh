// Gaussians to splats, and how many tiles each of them touches.

RGBAVATAR_FUNCTION Camera camera_of(const CameraArrays& cameras, const Frame& frame, int image) {
  const int which = cameras.count == 1 ? 0 : image;
  return camera_of_arrays(cameras.world_to_camera + which * 16, cameras.focal_px + which * 2,
                          cameras.principal_point_px + which * 2, frame.width, frame.height);
}

RGBAVATAR_FUNCTION Vec3<float> vec3_at(const float* rows, int64_t row) {
  return {rows[row * 3], rows[row * 3 + 1], rows[row * 3 + 2]};
}
RGBAVATAR_FUNCTION void put_vec3(const Vec3<float>& v, float* rows, int64_t row) {
  rows[row * 3] = v.x, rows[row * 3 + 1] = v.y, rows[row * 3 + 2] = v.z;
}

// Slots for a warp's Gaussians, one atomic addition for all of them. Beyond what fits, the numbers
// say nothing and nobody reads them.
RGBAVATAR_FUNCTION uint32_t warp_slots(uint32_t wanted, uint32_t* status) {
  const int lane = int(threadIdx.x) & 31;
  uint32_t sum = wanted;
  for (int step = 1; step < 32; step *= 2) {
    const uint32_t below = __shfl_up_sync(kWholeWarp, sum, step);
    if (lane >= step) sum += below;
  }
  uint32_t start = 0;
  auto* taken = reinterpret_cast<unsigned long long*>(status + kSlotsTaken);
  if (lane == 31 && sum) start = uint32_t(atomicAdd(taken, (unsigned long long)(sum)));
  return __shfl_sync(kWholeWarp, start, 31) + sum - wanted;
}

// Tiles first..last in one direction of the pixel centres that lie within `half` of the mean.
struct TileSpan {
  int first, last;
};
RGBAVATAR_FUNCTION TileSpan tile_span(float mean, float half, int side) {
  const float centre = mean - 0.5f;
  const float low = fmaxf(centre - half, 0.0f), high = fminf(centre + half, float(side - 1));
  if (!(ceilf(low) <= floorf(high))) return {1, 0};
  return {int(ceilf(low)) / kTileSide, int(floorf(high)) / kTileSide};
}

// Writes the splat, counts it in its tiles and takes its slots. All threads of a warp come here,
// `exists` or not.
RGBAVATAR_FUNCTION void emit(const Frame& frame, const Bins& bins, int image, int gaussian,
                             bool exists, const GaussianInput<float>& g, const Vec3<float>& color,
                             const Projection<float>& q) {
  const bool drawable = exists && is_drawable(g, color, q);
  const float log2_opacity = log2f(drawable ? g.opacity : 1.0f);
  const Extent<float> extent = extent_of(q, log2_opacity);
  const TileSpan x = drawable ? tile_span(q.mean_x, extent.half_x, frame.width) : TileSpan{1, 0};
  const TileSpan y = drawable ? tile_span(q.mean_y, extent.half_y, frame.height) : TileSpan{1, 0};
  const bool seen = x.first <= x.last && y.first <= y.last;
  Splat s;
  s.mean_x = q.mean_x, s.mean_y = q.mean_y, s.log2_opacity = log2_opacity;
  s.qa = q.conic00 * -C::kHalfLog2E;
  s.qb = q.conic01 * (-2.0f * C::kHalfLog2E);
  s.qc = q.conic11 * -C::kHalfLog2E;
  s.depth = q.p.z;
  s.red = color.x, s.green = color.y, s.blue = color.z;
  s.first_tile = seen ? uint32_t(x.first | y.first << 16) : 1u;
  s.last_tile = seen ? uint32_t(x.last | y.last << 16) : 0u;
  const uint32_t start = warp_slots(uint32_t(s.tiles()), bins.status);
  const int64_t first_row = int64_t(image) * frame.count;
  Splat* splats = reinterpret_cast<Splat*>(bins.splats) + first_row;
  if (exists) splats[gaussian] = s, bins.slot_start[first_row + gaussian] = start;
  __syncwarp();
  uint32_t* counts = bins.tile_count + int64_t(image) * frame.tiles_x * frame.tiles_y;
  for_each_tile(frame, splats, gaussian, s, [&](int, const Splat&, int x, int y) {
    atomicAdd(counts + y * frame.tiles_x + x, 1u);
  });
}

RGBAVATAR_FUNCTION GaussianInput<float> world_gaussian(const World& world, const Frame& frame,
                                                       int image, int gaussian) {
  const auto row = [&](int shared) {
    return (shared ? int64_t(0) : int64_t(image) * frame.count) + gaussian;
  };
  GaussianInput<float> g;
  g.mean = vec3_at(world.means, row(world.means_shared));
  const float* quat = world.quats + row(world.quats_shared) * 4;
  for (int k = 0; k < 4; ++k) g.quat[k] = quat[k];
  g.scale = vec3_at(world.scales, row(world.scales_shared));
  g.opacity = world.opacities[row(world.opacities_shared)];
  return g;
}

// World-space Gaussians. Blocks of 128 Gaussians, by images.
RGBAVATAR_KERNEL(project, ProjectArguments, kBlendThreads) {
  const int gaussian = int(blockIdx.x * blockDim.x + threadIdx.x), image = int(blockIdx.y);
  const bool exists = gaussian < a.frame.count;
  const int row = exists ? gaussian : 0;
  const GaussianInput<float> g = world_gaussian(a.world, a.frame, image, row);
  const int64_t first_row = int64_t(image) * a.frame.count;
  Projection<float> q = project(g, camera_of(a.cameras, a.frame, image));
  if (a.world.screen_offset) {
    const float* offset = a.world.screen_offset + (first_row + row) * 2;
    move_mean(offset[0], offset[1], q);
  }
  emit(a.frame, a.bins, image, gaussian, exists, g,
       vec3_at(a.world.colors, (a.world.colors_shared ? 0 : first_row) + row), q);
}

// ---- Morphed Gaussians --------------------------------------------------------------------------

// A triangle's frame in an image. `rows`: matrix, rotation, corner, edges, length ratio.
RGBAVATAR_KERNEL(frames, FramesArguments, kBlendThreads) {
  const int triangle = int(blockIdx.x * blockDim.x + threadIdx.x), image = int(blockIdx.y);
  const Morphed& b = a.blended;
  if (triangle >= b.triangles) return;
  const float* vertices = b.vertices + int64_t(image) * b.vertex_count * 3;
  const int64_t* corners = b.triangle_vertices + int64_t(triangle) * 3;
  const Vec3<float> corner = vec3_at(vertices, corners[0]);
  const Vec3<float> e1 = add_scaled(vec3_at(vertices, corners[1]), corner, -1.0f);
  const Vec3<float> e2 = add_scaled(vec3_at(vertices, corners[2]), corner, -1.0f);
  const TangentFrame<float> f =
      tangent_frame(e1, e2, b.edges_to_frame + int64_t(triangle) * 4, b.variant);
  float ratio = 1.0f;
  if (b.rest_length) {
    const Vec3<float> area = cross(e1, e2);
    const float half = 0.5f * square_root(dot(area, area));
    ratio = square_root(fmaxf(half, 1e-16f)) * reciprocal_of(b.rest_length[triangle]);
  }
  const float row[kFrameFloats] = {
      f.tangent.x, f.bitangent.x, f.normal.x, f.tangent.y, f.bitangent.y, f.normal.y,
      f.tangent.z, f.bitangent.z, f.normal.z, f.quat[0],   f.quat[1],     f.quat[2],
      f.quat[3],   corner.x,      corner.y,   corner.z,    e1.x,          e1.y,
      e1.z,        e2.x,          e2.y,       e2.z,        ratio,         0.0f};
  float* out = b.frames + (int64_t(image) * b.triangles + triangle) * kFrameFloats;
  for (int k = 0; k < kFrameFloats; k += 4)
    put_four({row[k], row[k + 1], row[k + 2], row[k + 3]}, out + k);
}

// Base + sum_k psi_k basis_k of an attribute, a column a thread, sixteen images at a time.
constexpr int kMorphImages = 16;
RGBAVATAR_FUNCTION void morph_columns(const float* base, const float* basis, int columns, int bases,
                                      int batch, const float* weights, int row, float* out) {
  const int column = int(blockIdx.x * blockDim.x + threadIdx.x);
  if (column >= columns) return;
  for (int first = 0; first < batch; first += kMorphImages) {
    float sums[kMorphImages];
    for (int i = 0; i < kMorphImages; ++i) sums[i] = base[column];
#pragma unroll 4
    for (int k = 0; k < bases; ++k) {
      const float value = basis[int64_t(k) * columns + column];
      const float* psi = weights + k * row + first;
#pragma unroll
      for (int i = 0; i < kMorphImages; i += 4) {
        if (first + i >= batch) break;
        const Four four = four_at(psi + i);
        sums[i] += four.x * value, sums[i + 1] += four.y * value;
        sums[i + 2] += four.z * value, sums[i + 3] += four.w * value;
      }
    }
#pragma unroll
    for (int i = 0; i < kMorphImages; ++i)
      if (first + i < batch) out[int64_t(first + i) * columns + column] = sums[i];
  }
}

// Bases are read here alone. Blocks of 256 columns, by position, rotation and colour.
RGBAVATAR_KERNEL(morph, MorphArguments, kTileThreads) {
  RGBAVATAR_DYNAMIC_SHARED(float, weights);
  const Morphed& b = a.blended;
  const int row = load_weights(b.weights, a.frame.batch, b.bases, weights);
  __syncthreads();
  const auto morph = [&](const float* base, const float* basis, int width, float* out) {
    morph_columns(base, basis, a.frame.count * width, basis ? b.bases : 0, a.frame.batch, weights,
                  row, out);
  };
  if (blockIdx.y == 0) morph(b.position, b.basis_position, 3, b.tangent_position);
  else if (blockIdx.y == 1) morph(b.rotation, b.basis_rotation, 4, b.tangent_rotation);
  else morph(b.color, b.basis_color, 3, b.tangent_color);
}

// A morphed Gaussian in the world of one image, and what carries it.
struct Carried {
  Vec3<float> row0, row1, row2;  // of the frame's matrix
  float frame_quat[4], ratio;
  Vec3<float> position;  // in the tangent frame, like the rotation
  float rotation[4];
  GaussianInput<float> gaussian;
  Vec3<float> color;
};

// exp2(-125) to exp2(125), as the CPU's; of what is no number the least.
RGBAVATAR_FUNCTION float bounded_exp(float x) {
  return power_of_two(fminf(fmaxf(x * (2.0f * C::kHalfLog2E), -125.0f), 125.0f));
}

RGBAVATAR_FUNCTION Carried carry(const Morphed& b, const Frame& frame, int image, int gaussian) {
  const int64_t row = int64_t(image) * frame.count + gaussian;
  const float* f =
      b.frames + (int64_t(image) * b.triangles + b.triangle_of[gaussian]) * kFrameFloats;
  Carried out;
  out.row0 = {f[0], f[1], f[2]}, out.row1 = {f[3], f[4], f[5]}, out.row2 = {f[6], f[7], f[8]};
  for (int k = 0; k < 4; ++k) out.frame_quat[k] = f[9 + k];
  const Four q = four_at(b.tangent_rotation + row * 4);
  out.rotation[0] = q.x, out.rotation[1] = q.y, out.rotation[2] = q.z, out.rotation[3] = q.w;
  out.ratio = f[22];
  const Vec3<float> along = vec3_at(b.barycentric, gaussian);
  const Vec3<float> origin =
      add_scaled(add_scaled(Vec3<float>{f[13], f[14], f[15]}, Vec3<float>{f[16], f[17], f[18]},
                            along.y),
                 Vec3<float>{f[19], f[20], f[21]}, along.z);
  const Vec3<float> x = out.position = vec3_at(b.tangent_position, row);
  GaussianInput<float>& g = out.gaussian;
  g.mean = {dot(out.row0, x) + origin.x, dot(out.row1, x) + origin.y, dot(out.row2, x) + origin.z};
  quat_product(out.frame_quat, out.rotation, g.quat);
  const Vec3<float> log_scale = vec3_at(b.log_scale, gaussian);
  g.scale = scaled(Vec3<float>{bounded_exp(log_scale.x), bounded_exp(log_scale.y),
                               bounded_exp(log_scale.z)},
                   out.ratio);
  const float logit = b.opacity_logit[gaussian];
  const bool numbers = logit == logit && log_scale.x == log_scale.x &&
                       log_scale.y == log_scale.y && log_scale.z == log_scale.z;
  g.opacity = numbers ? reciprocal_of(1.0f + bounded_exp(-logit)) : 0.0f;  // 0 is not drawn
  const Vec3<float> color = vec3_at(b.tangent_color, row);
  out.color = {color.x * kColorScale + 0.5f, color.y * kColorScale + 0.5f,
               color.z * kColorScale + 0.5f};
  return out;
}

// Carries to the world and projects what was morphed. Blocks of 128 Gaussians, by images.
RGBAVATAR_KERNEL(blend, BlendArguments, kBlendThreads) {
  const int gaussian = int(blockIdx.x * blockDim.x + threadIdx.x), image = int(blockIdx.y);
  const bool exists = gaussian < a.frame.count;
  const Carried c = carry(a.blended, a.frame, image, exists ? gaussian : 0);
  emit(a.frame, a.bins, image, gaussian, exists, c.gaussian, c.color,
       project(c.gaussian, camera_of(a.cameras, a.frame, image)));
}
