// Gaussians to splats and back, sixteen at a time.
#pragma once

#include "formulas.h"

namespace rgbavatar::RGBAVATAR_ISA {

static Camera camera_from(const float* c, int width, int height) {
  Camera out;
  out.row0 = {c[0], c[1], c[2]};
  out.row1 = {c[4], c[5], c[6]};
  out.row2 = {c[8], c[9], c[10]};
  out.translation = {c[3], c[7], c[11]};
  out.fx = c[16], out.fy = c[17], out.cx = c[18], out.cy = c[19];
  const float margin_u = C::kFrustumMargin * 0.5f * width / out.fx;
  const float margin_v = C::kFrustumMargin * 0.5f * height / out.fy;
  out.min_u = -out.cx / out.fx - margin_u, out.max_u = (width - out.cx) / out.fx + margin_u;
  out.min_v = -out.cy / out.fy - margin_v, out.max_v = (height - out.cy) / out.fy + margin_v;
  return out;
}

// Columns of rows [first, first + lanes) of a [N, K] array; further lanes are 0.
template <int K>
static inline void load_columns(const float* rows, int first, int lanes, Wide out[K]) {
  float columns[K][kLanes] = {};
  for (int lane = 0; lane < lanes; ++lane)
    for (int k = 0; k < K; ++k) columns[k][lane] = rows[int64_t(first + lane) * K + k];
  for (int k = 0; k < K; ++k) load(out[k], columns[k]);
}

template <int K>
static inline void add_columns(float* rows, int first, int lanes, const Wide values[K]) {
  float columns[K][kLanes];
  for (int k = 0; k < K; ++k) store(values[k], columns[k]);
  for (int lane = 0; lane < lanes; ++lane)
    for (int k = 0; k < K; ++k) rows[int64_t(first + lane) * K + k] += columns[k][lane];
}

static inline GaussianInput<Wide> load_gaussians(const Scene& scene, int image, int first,
                                                 int lanes) {
  GaussianInput<Wide> g;
  Wide column[3];
  load_columns<3>(scene.means.of(image), first, lanes, column);
  g.mean = {column[0], column[1], column[2]};
  load_columns<4>(scene.quats.of(image), first, lanes, g.quat);
  load_columns<3>(scene.scales.of(image), first, lanes, column);
  g.scale = {column[0], column[1], column[2]};
  load_columns<1>(scene.opacities.of(image), first, lanes, &g.opacity);
  return g;
}

static inline int floor_of_positive(float x) { return int(x); }
static inline int ceil_of_positive(float x) { return int(x) + (float(int(x)) < x); }

// Sets the range of blocks whose pixel centres lie within [low, high]; both are already clamped
// to [0, side - 1] in units of pixel indices.
static inline bool block_range(float low, float high, uint16_t& first, uint16_t& last) {
  if (!(low <= high)) return false;
  const int first_pixel = ceil_of_positive(low), last_pixel = floor_of_positive(high);
  first = uint16_t(first_pixel / kBlockSide);
  last = uint16_t(last_pixel / kBlockSide);
  return first_pixel <= last_pixel;
}

static void project_image(const Scene& scene, const float* camera_floats, int image, int begin,
                          int end, Splat* splats, Bounds* bounds) {
  const Camera camera = camera_from(camera_floats, scene.width, scene.height);
  for (int first = begin; first < end; first += kLanes) {
    const int lanes = end - first < kLanes ? end - first : kLanes;
    const GaussianInput<Wide> g = load_gaussians(scene, image, first, lanes);
    Wide rgb[3];
    load_columns<3>(scene.colors.of(image), first, lanes, rgb);
    const Projection<Wide> q = project(g, camera);
    const WideMask drawable = is_drawable(g, Vec3<Wide>{rgb[0], rgb[1], rgb[2]}, q);
    const Wide log2_opacity = log2_of(select(drawable, g.opacity, Wide(1.0f)));
    // Where alpha falls to the cut: -k d^T Q d = log2(min alpha / o), an ellipse of half-widths
    // sqrt(2 ln(o / min alpha) cov).
    const Wide reach = (log2_opacity - C::kLog2MinAlpha) * (2.0f * C::kLn2);
    const Wide half_x = square_root(reach * q.cov00), half_y = square_root(reach * q.cov11);
    const Wide centre_x = q.mean_x - 0.5f, centre_y = q.mean_y - 0.5f;
    enum { kMeanX, kMeanY, kOpacity, kQa, kQb, kQc, kLowX, kHighX, kLowY, kHighY, kColumns };
    float column[kColumns][kLanes];
    store(q.mean_x, column[kMeanX]);
    store(q.mean_y, column[kMeanY]);
    store(log2_opacity, column[kOpacity]);
    store(q.conic00 * -C::kHalfLog2E, column[kQa]);
    store(q.conic01 * (-2.0f * C::kHalfLog2E), column[kQb]);
    store(q.conic11 * -C::kHalfLog2E, column[kQc]);
    // Beyond the image the comparison low <= high fails; so it does for what is not drawable.
    store(select(drawable, max_of(centre_x - half_x, Wide(0.0f)), Wide(1e9f)), column[kLowX]);
    store(min_of(centre_x + half_x, Wide(scene.width - 1.0f)), column[kHighX]);
    store(max_of(centre_y - half_y, Wide(0.0f)), column[kLowY]);
    store(min_of(centre_y + half_y, Wide(scene.height - 1.0f)), column[kHighY]);
    float depth[kLanes], color[3][kLanes];
    store(q.p.z, depth);
    for (int k = 0; k < 3; ++k) store(rgb[k], color[k]);
    for (int lane = 0; lane < lanes; ++lane) {
      Bounds& box = bounds[first + lane];
      const bool seen = block_range(column[kLowX][lane], column[kHighX][lane], box.first_block_x,
                                    box.last_block_x) &&
                        block_range(column[kLowY][lane], column[kHighY][lane], box.first_block_y,
                                    box.last_block_y);
      if (!seen) {
        box.first_block_x = 1, box.last_block_x = 0;
        continue;
      }
      Splat& s = splats[first + lane];
      s.bounds = box;
      s.mean_x = column[kMeanX][lane], s.mean_y = column[kMeanY][lane];
      s.log2_opacity = column[kOpacity][lane];
      s.qa = column[kQa][lane], s.qb = column[kQb][lane], s.qc = column[kQc][lane];
      s.red = color[0][lane], s.green = color[1][lane], s.blue = color[2][lane];
      s.depth = depth[lane];
    }
  }
}

static void project_image_backward(const Scene& scene, const float* camera_floats, int image,
                                   int begin, int end, const uint32_t* slot_offset,
                                   const float* slots, const SceneGradient& gradient) {
  const Camera camera = camera_from(camera_floats, scene.width, scene.height);
  for (int first = begin; first < end; first += kLanes) {
    const int lanes = end - first < kLanes ? end - first : kLanes;
    if (slot_offset[first] == slot_offset[first + lanes]) continue;
    float sums[kMoments][kLanes] = {};
    float seen[kLanes] = {};
    for (int lane = 0; lane < lanes; ++lane) {
      const uint32_t stop = slot_offset[first + lane + 1];
      for (uint32_t slot = slot_offset[first + lane]; slot < stop; ++slot) {
        seen[lane] = 1.0f;
        for (int k = 0; k < kMoments; ++k) sums[k][lane] += slots[int64_t(slot) * kMoments + k];
      }
    }
    Wide m[kMoments];
    for (int k = 0; k < kMoments; ++k) load(m[k], sums[k]);
    const Moments<Wide> moments = {{m[0], m[1], m[2]}, m[3], m[4], m[5], m[6], m[7], m[8]};
    const GaussianInput<Wide> g = load_gaussians(scene, image, first, lanes);
    const Projection<Wide> q = project(g, camera);
    const GaussianGradient<Wide> d = project_backward(g, camera, q, moments);
    // What was not drawn may hold anything; its gradient is 0.
    const WideMask drawn = load_wide(seen) > Wide(0.0f);
    const Wide zero(0.0f);
    const Wide mean[3] = {select(drawn, d.mean.x, zero), select(drawn, d.mean.y, zero),
                          select(drawn, d.mean.z, zero)};
    const Wide quat[4] = {select(drawn, d.quat[0], zero), select(drawn, d.quat[1], zero),
                          select(drawn, d.quat[2], zero), select(drawn, d.quat[3], zero)};
    const Wide scale[3] = {select(drawn, d.scale.x, zero), select(drawn, d.scale.y, zero),
                           select(drawn, d.scale.z, zero)};
    const Wide opacity[1] = {select(drawn, d.opacity, zero)};
    add_columns<3>(gradient.means, first, lanes, mean);
    add_columns<4>(gradient.quats, first, lanes, quat);
    add_columns<3>(gradient.scales, first, lanes, scale);
    add_columns<1>(gradient.opacities, first, lanes, opacity);
    add_columns<3>(gradient.colors, first, lanes, m);
  }
}

}  // namespace rgbavatar::RGBAVATAR_ISA
