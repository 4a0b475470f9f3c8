// Gaussians to splats and back, sixteen at a time.
#pragma once

#include "formulas.h"

namespace rgbavatar::RGBAVATAR_ISA {

static Camera camera_from(const float* c, int width, int height) {
  return camera_of_arrays(c, c + 16, c + 18, width, height);
}

// Sixteen rows of a [N, K] array: in place, or a copy padded with zeros at the array's end.
template <int K>
struct Rows {
  float padded[kLanes * K];
  const float* data;

  Rows(const float* rows, int first, int lanes) : data(rows + int64_t(first) * K) {
    if (lanes == kLanes) return;
    for (int i = 0; i < kLanes * K; ++i) padded[i] = i < lanes * K ? data[i] : 0.0f;
    data = padded;
  }
};

// The same for writing: what lies behind the array's end is dropped.
template <int K>
struct OutputRows {
  float padded[kLanes * K];
  float *target, *data;
  int floats;

  OutputRows(float* rows, int first, int lanes)
      : target(rows + int64_t(first) * K),
        data(lanes == kLanes ? target : padded),
        floats(lanes * K) {}
  ~OutputRows() {
    if (data == padded)
      for (int i = 0; i < floats; ++i) target[i] = padded[i];
  }
};

static RGBAVATAR_MEMBER Vec3<Wide> load_vec3(const float* rows, int first, int lanes) {
  const Rows<3> in(rows, first, lanes);
  Quad x[4], y[4], z[4];
  for (int i = 0; i < 4; ++i) load_interleaved(in.data + 12 * i, x[i], y[i], z[i]);
  return {wide_of(x[0], x[1], x[2], x[3]), wide_of(y[0], y[1], y[2], y[3]),
          wide_of(z[0], z[1], z[2], z[3])};
}

static RGBAVATAR_MEMBER void load_quats(const float* rows, int first, int lanes, Wide out[4]) {
  const Rows<4> in(rows, first, lanes);
  load_columns([&](int i) { return in.data + 4 * i; }, out);
}

template <int i>
static RGBAVATAR_MEMBER void store_quarter(const Vec3<Wide>& v, float* to) {
  store_interleaved(quad_of<i>(v.x), quad_of<i>(v.y), quad_of<i>(v.z), to + 12 * i);
}

static RGBAVATAR_MEMBER void store_vec3(const Vec3<Wide>& v, float* rows, int first, int lanes) {
  const OutputRows<3> out(rows, first, lanes);
  store_quarter<0>(v, out.data);
  store_quarter<1>(v, out.data);
  store_quarter<2>(v, out.data);
  store_quarter<3>(v, out.data);
}

static RGBAVATAR_MEMBER void store_quats(const Wide v[4], float* rows, int first, int lanes) {
  const OutputRows<4> out(rows, first, lanes);
  store_columns(v, [&](int i) { return out.data + 4 * i; });
}

static RGBAVATAR_MEMBER Wide load_column(const float* rows, int first, int lanes) {
  return load_wide(Rows<1>(rows, first, lanes).data);
}

// Moves sixteen means by what their rows of [N, 2] say.
static RGBAVATAR_MEMBER void move_means(const float* screen_offset, int first, int lanes,
                                        Projection<Wide>& q) {
  const Rows<2> in(screen_offset, first, lanes);
  float x[kLanes], y[kLanes];
  for (int i = 0; i < kLanes; ++i) x[i] = in.data[2 * i], y[i] = in.data[2 * i + 1];
  move_mean(load_wide(x), load_wide(y), q);
}

static RGBAVATAR_MEMBER void store_pairs(const Wide& x, const Wide& y, float* rows, int first,
                                         int lanes) {
  float columns[2][kLanes];
  store(x, columns[0]);
  store(y, columns[1]);
  const OutputRows<2> out(rows, first, lanes);
  for (int i = 0; i < 2 * kLanes; ++i) out.data[i] = columns[i % 2][i / 2];
}

static RGBAVATAR_MEMBER GaussianInput<Wide> load_gaussians(const Scene& scene, int image, int first,
                                                 int lanes) {
  GaussianInput<Wide> g;
  g.mean = load_vec3(scene.means.of(image), first, lanes);
  load_quats(scene.quats.of(image), first, lanes, g.quat);
  g.scale = load_vec3(scene.scales.of(image), first, lanes);
  g.opacity = load_column(scene.opacities.of(image), first, lanes);
  return g;
}

// Floor and ceiling of numbers from 0 to 2^24.
static RGBAVATAR_MEMBER WideInt floor_of(const Wide& x) { return to_ints(x); }
static RGBAVATAR_MEMBER WideInt ceil_of(const Wide& x) {
  const Wide below = to_floats(to_ints(x));
  return to_ints(select(x > below, below + 1.0f, below));
}

// Blocks first..last that hold the pixel indices low..high; both are within the image.
struct BlockSpan {
  WideInt first, last;
};
static RGBAVATAR_MEMBER BlockSpan span_of(const Wide& low, const Wide& high) {
  return {ceil_of(low) >> 2, floor_of(high) >> 2};
}

// Which blocks the ellipses touch, as words of four rows of eight bits, for those whose bounds fit
// the window. An ellipse d^T cov^-1 d = reach ends, along the row dy, at
//   dx = (cov01 dy +- sqrt(det (cov11 reach - dy^2))) / cov11,
// and is widest where dy = +-cov01 sqrt(reach / cov00): the block row's dy nearest to that.
static RGBAVATAR_MEMBER Wide quick_root(const Wide& a) {
  const Wide positive = max_of(a, Wide(1e-20f));
  return positive * inverse_root_of(positive);
}

struct TouchedBlocks {
  WideInt upper, lower;
};
static inline TouchedBlocks touched_blocks(int width, const Projection<Wide>& q,
                                           const Wide& cov01, const Wide& reach,
                                           const Wide& half_x, const Wide& half_y,
                                           const BlockSpan& x, const BlockSpan& y,
                                           const WideMask& fits) {
  constexpr float kSlackPx = 0.02f;  // more than rounding makes of a bound within the window
  const Wide inverse_cov11 = reciprocal_of(q.cov11);
  const Wide slope = cov01 * inverse_cov11;
  const Wide spread = q.determinant * inverse_cov11 * inverse_cov11;
  const Wide widest = cov01 * half_x * reciprocal_of(q.cov00);
  const Wide rows = to_floats(y.last - y.first);
  const Wide left = to_floats(x.first);
  TouchedBlocks touched = {0, 0};
  Wide first_dy = to_floats(y.first) * float(kBlockSide) + 0.5f - q.mean_y;
  for (int row = 0; row < kWindow && any((rows >= Wide(float(row))) & fits); ++row) {
    const Wide low = max_of(first_dy, Wide(0.0f) - half_y);
    const Wide high = min_of(first_dy + (kBlockSide - 1.0f), half_y);
    const Wide dy_right = min_of(max_of(widest, low), high);
    const Wide dy_left = min_of(max_of(Wide(0.0f) - widest, low), high);
    const Wide square = q.cov11 * reach;
    const Wide right = quick_root((square - dy_right * dy_right) * spread);
    const Wide to_left = quick_root((square - dy_left * dy_left) * spread);
    const Wide centre = q.mean_x - 0.5f;
    const Wide start = max_of(centre + slope * dy_left - to_left - kSlackPx, Wide(0.0f));
    const Wide stop = min_of(centre + slope * dy_right + right + kSlackPx,
                             Wide(width - 1.0f));
    const WideMask some = (rows >= Wide(float(row))) & fits & (stop >= start);
    // From the first bit to the last, within the eight of this row; none where start > stop.
    const BlockSpan span = span_of(select(some, start, Wide(4.0f)), select(some, stop, Wide(0.0f)));
    const Wide first_bit = max_of(select(some, to_floats(span.first) - left, Wide(1.0f)), Wide(0.0f));
    const Wide last_bit = min_of(select(some, to_floats(span.last) - left, Wide(0.0f)), Wide(7.0f));
    const WideMask touches = last_bit >= first_bit;
    const WideInt from = to_ints(select(touches, first_bit, Wide(0.0f)));
    const WideInt past = to_ints(select(touches, last_bit + 1.0f, Wide(0.0f)));
    const WideInt bits = (WideInt(1) << past) - (WideInt(1) << from);
    if (row < kWindow / 2)
      touched.upper = touched.upper | (bits << WideInt(8 * row));
    else
      touched.lower = touched.lower | (bits << WideInt(8 * row - 32));
    first_dy = first_dy + float(kBlockSide);
  }
  return touched;
}

// The tiles of these blocks as `Projected` has them, in the bits of floats.
static RGBAVATAR_MEMBER Wide tiles_of(const BlockSpan& x, const BlockSpan& y, int tiles_x) {
  const WideInt first_x = x.first >> kTileBlocksShift, first_y = y.first >> kTileBlocksShift;
  const WideInt right = (x.last >> kTileBlocksShift) - first_x;
  const WideInt below = (y.last >> kTileBlocksShift) - first_y;
  const WideInt first = to_ints(to_floats(first_y) * float(tiles_x) + to_floats(first_x));
  const WideMask few = (Wide(1.0f) >= to_floats(right)) & (Wide(1.0f) >= to_floats(below));
  static_assert(kTileRight == 1 && kTileBelow == 2, "right and below are bits as they stand");
  return select(few, bits_as_floats((first << kTileShift) | right | (below << 1)),
                bits_as_floats(WideInt(int32_t(kManyTiles))));
}

// Projects sixteen Gaussians, moves them where there are offsets [N, 2], and writes their splats.
static inline void project_lanes(int width, int height, const Camera& camera,
                                 const GaussianInput<Wide>& g, const Vec3<Wide>& color,
                                 const float* screen_offset, int first, int lanes,
                                 const Projected& out) {
  static_assert(sizeof(Splat) == 16 * sizeof(float), "a splat is sixteen columns");
  Projection<Wide> q = project(g, camera);
  if (screen_offset) move_means(screen_offset, first, lanes, q);
  const WideMask drawable = is_drawable(g, color, q);
  const Wide log2_opacity = log2_of(select(drawable, g.opacity, Wide(1.0f)));
  const Extent<Wide> extent = extent_of(q, log2_opacity);
  const Wide reach = extent.reach, half_x = extent.half_x, half_y = extent.half_y;
  const Wide centre_x = q.mean_x - 0.5f, centre_y = q.mean_y - 0.5f;
  const Wide low_x = max_of(centre_x - half_x, Wide(0.0f));
  const Wide low_y = max_of(centre_y - half_y, Wide(0.0f));
  const Wide high_x = min_of(centre_x + half_x, Wide(width - 1.0f));
  const Wide high_y = min_of(centre_y + half_y, Wide(height - 1.0f));
  // The first comparisons keep what is far outside, or not drawable, from the conversion to
  // integers; the second ones ask for a pixel centre.
  const WideMask near = drawable & (high_x >= low_x) & (high_y >= low_y);
  const Wide zero(0.0f), left = select(near, low_x, zero), right = select(near, high_x, zero);
  const Wide top = select(near, low_y, zero), bottom = select(near, high_y, zero);
  const WideMask seen = near & (to_floats(floor_of(right)) >= left) &
                        (to_floats(floor_of(bottom)) >= top);
  const BlockSpan x = span_of(left, right), y = span_of(top, bottom);
  const WideMask fits = seen & (Wide(kWindow - 1.0f) >= to_floats(x.last - x.first)) &
                        (Wide(kWindow - 1.0f) >= to_floats(y.last - y.first));
  const TouchedBlocks touched = touched_blocks(
      width, q, zero - q.conic01 * q.determinant, reach, half_x, half_y, x, y, fits);
  const WideInt all(-1);
  const Wide columns[16] = {q.mean_x,
                            q.mean_y,
                            log2_opacity,
                            q.conic00 * -C::kHalfLog2E,
                            q.conic01 * (-2.0f * C::kHalfLog2E),
                            q.conic11 * -C::kHalfLog2E,
                            color.x,
                            color.y,
                            color.z,
                            q.p.z,
                            bits_as_floats(x.first | (y.first << 16)),
                            bits_as_floats(x.last | (y.last << 16)),
                            select(fits, bits_as_floats(touched.upper), bits_as_floats(all)),
                            select(fits, bits_as_floats(touched.lower), bits_as_floats(all)),
                            zero,
                            zero};
  Splat padded[kLanes];
  Splat* splats = lanes == kLanes ? out.splats + first : padded;
  for (int k = 0; k < 16; k += 4)
    store_columns(columns + k, [&](int i) { return &splats[i].mean_x + k; });
  if (lanes < kLanes)
    for (int lane = 0; lane < lanes; ++lane) out.splats[first + lane] = padded[lane];
  store(q.p.z, OutputRows<1>(out.depth, first, lanes).data);
  const Wide none = bits_as_floats(WideInt(out.tile_count << kTileShift));
  store(select(seen, tiles_of(x, y, out.tiles_x), none),
        OutputRows<1>(reinterpret_cast<float*>(out.tiles), first, lanes).data);
}

static void project_image(const Scene& scene, const float* camera_floats, int image, int begin,
                          int end, const Projected& out) {
  const Camera camera = camera_from(camera_floats, scene.width, scene.height);
  for (int first = begin; first < end; first += kLanes) {
    const int lanes = end - first < kLanes ? end - first : kLanes;
    project_lanes(scene.width, scene.height, camera, load_gaussians(scene, image, first, lanes),
                  load_vec3(scene.colors.of(image), first, lanes), scene.screen_offset.of(image),
                  first, lanes, out);
  }
}

// The sums over the slots of sixteen Gaussians, and which of them have any.
struct LaneMoments {
  Moments<Wide> sums;
  WideMask drawn;
};

static RGBAVATAR_MEMBER LaneMoments sum_slots(const ImageSlots& image, int first, int lanes) {
  alignas(64) float sums[kLanes][12];
  float seen[kLanes] = {};
  for (int lane = 0; lane < kLanes; ++lane) {
    Quad a = {}, b = {}, c = {};
    if (lane < lanes) {
      const uint32_t start = image.offset[first + lane], stop = image.offset[first + lane + 1];
      seen[lane] = float(stop - start);
      for (uint32_t slot = start; slot < stop; ++slot) {
        const float* from = image.slots + int64_t(slot) * kMoments;
        a = a + load_quad(from);
        b = b + load_quad(from + 4);
        c = c + load_quad(from + 8);
      }
    }
    store_quad(a, sums[lane]);
    store_quad(b, sums[lane] + 4);
    store_quad(c, sums[lane] + 8);
  }
  Wide m[12];
  for (int k = 0; k < 12; k += 4)
    load_columns([&](int i) { return sums[i] + k; }, m + k);
  return {{{m[0], m[1], m[2]}, m[3], m[4], m[5], m[6], m[7], m[8]},
          load_wide(seen) > Wide(0.0f)};
}

// The gradient of sixteen Gaussians of one image; 0 for what was not drawn, which may hold
// anything.
static RGBAVATAR_MEMBER GaussianGradient<Wide> gradient_lanes(const GaussianInput<Wide>& g,
                                                              const Camera& camera,
                                                              const LaneMoments& moments) {
  const GaussianGradient<Wide> d = project_backward(g, camera, project(g, camera), moments.sums);
  const Wide zero(0.0f);
  const auto keep = [&](const Wide& x) __attribute__((always_inline)) {
    return select(moments.drawn, x, zero);
  };
  return {{keep(d.mean.x), keep(d.mean.y), keep(d.mean.z)},
          {keep(d.quat[0]), keep(d.quat[1]), keep(d.quat[2]), keep(d.quat[3])},
          {keep(d.scale.x), keep(d.scale.y), keep(d.scale.z)},
          keep(d.opacity),
          keep(d.mean_x),
          keep(d.mean_y)};
}

// Writes, or adds to what is there.
static RGBAVATAR_MEMBER void put_vec3(Vec3<Wide> v, bool add, float* rows, int first, int lanes) {
  if (add) {
    const Vec3<Wide> old = load_vec3(rows, first, lanes);
    v = {v.x + old.x, v.y + old.y, v.z + old.z};
  }
  store_vec3(v, rows, first, lanes);
}

static void project_image_backward(const Scene& scene, const float* camera_floats, int image,
                                   int begin, int end, const ImageSlots& slots,
                                   const SceneGradient& gradient) {
  const Camera camera = camera_from(camera_floats, scene.width, scene.height);
  // What the batch shares is a sum over the images.
  const auto adds = [&](const Attribute& attribute) {
    return image > 0 && attribute.batch_stride == 0;
  };
  const auto of_image = [&](const Attribute& attribute, float* grads) {
    return grads + image * attribute.batch_stride;
  };
  for (int first = begin; first < end; first += kLanes) {
    const int lanes = end - first < kLanes ? end - first : kLanes;
    const LaneMoments moments = sum_slots(slots, first, lanes);
    GaussianGradient<Wide> d =
        gradient_lanes(load_gaussians(scene, image, first, lanes), camera, moments);
    put_vec3(d.mean, adds(scene.means), of_image(scene.means, gradient.means), first, lanes);
    put_vec3(d.scale, adds(scene.scales), of_image(scene.scales, gradient.scales), first, lanes);
    put_vec3(moments.sums.color, adds(scene.colors), of_image(scene.colors, gradient.colors), first,
             lanes);
    float* quats = of_image(scene.quats, gradient.quats);
    if (adds(scene.quats)) {
      Wide old[4];
      load_quats(quats, first, lanes, old);
      for (int k = 0; k < 4; ++k) d.quat[k] = d.quat[k] + old[k];
    }
    store_quats(d.quat, quats, first, lanes);
    float* opacities = of_image(scene.opacities, gradient.opacities);
    if (adds(scene.opacities)) d.opacity = d.opacity + load_column(opacities, first, lanes);
    const OutputRows<1> out(opacities, first, lanes);
    store(d.opacity, out.data);
    if (gradient.screen_offset)
      store_pairs(d.mean_x, d.mean_y, of_image(scene.screen_offset, gradient.screen_offset), first,
                  lanes);
  }
}

}  // namespace rgbavatar::RGBAVATAR_ISA
