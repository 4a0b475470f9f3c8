// The loops over Gaussians and pixels. Compiled once per instruction set with RGBAVATAR_ISA naming
// it; uses no inline function or template of the standard library, because the linker would merge
// those of different instruction sets.
#include "layout.h"
#include "simd.h"

namespace rgbavatar::RGBAVATAR_ISA {

#include "../../shared/gaussian_math.h"

using C = BlendingConstants;

// ---- Projection -------------------------------------------------------------------------------

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

// ---- Tiles ------------------------------------------------------------------------------------

struct BlockRange {
  int first_x, last_x, first_y, last_y;  // within the tile, inclusive
};

static inline BlockRange blocks_in_tile(const Bounds& s, int origin_x, int origin_y) {
  const int x0 = s.first_block_x - origin_x, x1 = s.last_block_x - origin_x;
  const int y0 = s.first_block_y - origin_y, y1 = s.last_block_y - origin_y;
  return {x0 > 0 ? x0 : 0, x1 < kTileBlocks ? x1 : kTileBlocks - 1, y0 > 0 ? y0 : 0,
          y1 < kTileBlocks ? y1 : kTileBlocks - 1};
}

// Centres of a block's pixels.
struct PixelCentres {
  Wide x, y;
  PixelCentres() {
    float lane_x[kBlockPixels], lane_y[kBlockPixels];
    for (int i = 0; i < kBlockPixels; ++i) {
      lane_x[i] = i % kBlockSide + 0.5f;
      lane_y[i] = i / kBlockSide + 0.5f;
    }
    load(x, lane_x);
    load(y, lane_y);
  }
};

// The part of a block that lies in the image.
struct BlockPixels {
  int64_t first;  // index of its first pixel in the image
  int rows, columns;

  BlockPixels(const Tile& tile, int block) {
    const int left = (tile.tile_x * kTileBlocks + block % kTileBlocks) * kBlockSide;
    const int top = (tile.tile_y * kTileBlocks + block / kTileBlocks) * kBlockSide;
    first = int64_t(top) * tile.width + left;
    rows = tile.height - top < kBlockSide ? tile.height - top : kBlockSide;
    columns = tile.width - left < kBlockSide ? tile.width - left : kBlockSide;
  }
  bool whole() const { return rows == kBlockSide && columns == kBlockSide; }

  // Calls visit(lane, pixel index) for each of them.
  template <class Visit>
  void for_each(const Tile& tile, Visit visit) const {
    for (int y = 0; y < rows; ++y)
      for (int x = 0; x < columns; ++x) visit(y * kBlockSide + x, first + y * tile.width + x);
  }
};

// Rows of a block in the scratch memory: transmittance, red, green and blue (or other channels),
// then depth (forward) or remainder (backward).
enum { kTransmittance = 0, kColor = 1, kDepth = 4, kRemainder = 4, kBlendRows = 5 };

template <int kRows>
static RGBAVATAR_MEMBER float (*block_rows(TileScratch& scratch, int block))[kBlockPixels] {
  return scratch.rows + block * kRows;
}

// T is 1 in the image and 0 outside it, so that pixels outside neither take part in the blending
// nor keep their block open. The other rows are 0.
template <int kRows>
static void start_rows(const Tile& tile, TileScratch& scratch) {
  for (int block = 0; block < kBlocksPerTile; ++block) {
    float(*rows)[kBlockPixels] = block_rows<kRows>(scratch, block);
    const BlockPixels pixels(tile, block);
    store(Wide(pixels.whole() ? 1.0f : 0.0f), rows[kTransmittance]);
    if (!pixels.whole())
      pixels.for_each(tile, [&](int lane, int64_t) { rows[kTransmittance][lane] = 1.0f; });
    for (int k = 1; k < kRows; ++k) store(Wide(0.0f), rows[k]);
  }
}

// Copies the tile's next Gaussians, which lie far apart, to scratch.portion.
static int load_portion(const Tile& tile, uint32_t first, TileScratch& scratch) {
  constexpr uint32_t kAhead = 12;
  const uint32_t rest = tile.entry_count - first;
  const uint32_t count = rest < uint32_t(kPortion) ? rest : kPortion;
  const uint32_t* entries = tile.entries + first;
  for (uint32_t i = 0; i < kAhead && i < count; ++i) __builtin_prefetch(&tile.splats[entries[i]]);
  for (uint32_t i = 0; i < count; ++i) {
    if (i + kAhead < count) __builtin_prefetch(&tile.splats[entries[i + kAhead]]);
    scratch.portion[i] = tile.splats[entries[i]];
  }
  return int(count);
}

// Which of the portion's Gaussians touch each block, as scratch.list.
static void list_by_block(const Tile& tile, int count, TileScratch& scratch) {
  const int origin_x = tile.tile_x * kTileBlocks, origin_y = tile.tile_y * kTileBlocks;
  for (int block = 0; block < kBlocksPerTile; ++block) scratch.list_size[block] = 0;
  for (int i = 0; i < count; ++i) {
    const BlockRange r = blocks_in_tile(scratch.portion[i].bounds, origin_x, origin_y);
    for (int y = r.first_y; y <= r.last_y; ++y)
      for (int x = r.first_x; x <= r.last_x; ++x) {
        const int block = y * kTileBlocks + x;
        scratch.list[block][scratch.list_size[block]++] = uint16_t(i);
      }
  }
}

struct Alpha {
  Wide raw, value;  // before the cap, and as blended; both 0 below the cut
};

static RGBAVATAR_MEMBER Alpha alpha_at(const Wide& dx, const Wide& dy, const Splat& s) {
  const Wide p = log2_alpha(dx, dy, s.log2_opacity, s.qa, s.qb, s.qc);
  const Wide raw = select(p >= Wide(C::kLog2MinAlpha), exp2_of(p), Wide(0.0f));
  return {raw, min_of(raw, Wide(C::kMaxAlpha))};
}

static RGBAVATAR_MEMBER bool is_open(const Wide& transmittance) {
  return any(transmittance >= Wide(C::kMinTransmittance));
}

template <int kRows>
static bool any_open(TileScratch& scratch) {
  for (int block = 0; block < kBlocksPerTile; ++block)
    if (is_open(load_wide(block_rows<kRows>(scratch, block)[kTransmittance]))) return true;
  return false;
}

// Blends a block's list into its rows.
template <bool kWithDepth>
static inline void blend_block(const Tile& tile, const PixelCentres& centres, int block,
                               TileScratch& scratch) {
  const Wide px = centres.x + float((tile.tile_x * kTileBlocks + block % kTileBlocks) * kBlockSide);
  const Wide py = centres.y + float((tile.tile_y * kTileBlocks + block / kTileBlocks) * kBlockSide);
  float(*rows)[kBlockPixels] = block_rows<kBlendRows>(scratch, block);
  Wide t = load_wide(rows[kTransmittance]), red = load_wide(rows[kColor]);
  Wide green = load_wide(rows[kColor + 1]), blue = load_wide(rows[kColor + 2]);
  Wide depth = load_wide(rows[kDepth]);
  const int size = scratch.list_size[block];
  for (int i = 0; i < size && is_open(t); ++i) {
    const Splat& s = scratch.portion[scratch.list[block][i]];
    const Wide w = alpha_at(px - s.mean_x, py - s.mean_y, s).value * t;
    red = red + w * s.red;
    green = green + w * s.green;
    blue = blue + w * s.blue;
    if (kWithDepth) depth = depth + w * s.depth;
    t = t - w;
  }
  store(t, rows[kTransmittance]);
  store(red, rows[kColor]);
  store(green, rows[kColor + 1]);
  store(blue, rows[kColor + 2]);
  if (kWithDepth) store(depth, rows[kDepth]);
}

// Puts the background behind the block and writes it to the image.
static void write_block(const Tile& tile, const ForwardOutput& out, int block,
                        TileScratch& scratch) {
  float(*rows)[kBlockPixels] = block_rows<kBlendRows>(scratch, block);
  const float* transmittance = rows[kTransmittance];
  float(*channels)[kBlockPixels] = rows + kColor;
  const Wide t = load_wide(transmittance);
  for (int k = 0; k < 3; ++k)
    store(load_wide(channels[k]) + t * out.background[k], channels[k]);
  const BlockPixels pixels(tile, block);
  if (pixels.whole()) {
    for (int y = 0; y < kBlockSide; ++y) {
      const int lane = y * kBlockSide;
      const int64_t pixel = pixels.first + y * tile.width;
      store_interleaved(load_quad(channels[0] + lane), load_quad(channels[1] + lane),
                        load_quad(channels[2] + lane), out.image + pixel * 3);
      store_quad(1.0f - load_quad(transmittance + lane), out.alpha + pixel);
    }
  } else {
    pixels.for_each(tile, [&](int lane, int64_t pixel) {
      for (int k = 0; k < 3; ++k) out.image[pixel * 3 + k] = channels[k][lane];
      out.alpha[pixel] = 1.0f - transmittance[lane];
    });
  }
  if (!out.depth) return;
  pixels.for_each(tile, [&](int lane, int64_t pixel) {
    const float alpha = 1.0f - transmittance[lane];
    out.depth[pixel] = alpha > 0.0f ? rows[kDepth][lane] / alpha : 0.0f;
  });
}

static void forward_tile(const Tile& tile, const ForwardOutput& out, TileScratch& scratch) {
  const PixelCentres centres;
  start_rows<kBlendRows>(tile, scratch);
  for (uint32_t first = 0; first < tile.entry_count; first += kPortion) {
    if (first && !any_open<kBlendRows>(scratch)) break;
    list_by_block(tile, load_portion(tile, first, scratch), scratch);
    for (int block = 0; block < kBlocksPerTile; ++block) {
      if (scratch.list_size[block] == 0) continue;
      if (out.depth)
        blend_block<true>(tile, centres, block, scratch);
      else
        blend_block<false>(tile, centres, block, scratch);
    }
  }
  for (int block = 0; block < kBlocksPerTile; ++block) write_block(tile, out, block, scratch);
}

// ---- Gaussian-stationary passes ---------------------------------------------------------------

// Calls visit(dx, dy, transmittance, rows) for the open blocks that the Gaussian touches. The visit
// updates the transmittance as the forward pass did, so that the same blocks close at the
// same Gaussian.
template <int kRows, class Visit>
static RGBAVATAR_MEMBER void for_open_blocks(const Tile& tile, const PixelCentres& centres,
                                             const Splat& s, TileScratch& scratch, Visit visit) {
  const int origin_x = tile.tile_x * kTileBlocks, origin_y = tile.tile_y * kTileBlocks;
  const BlockRange r = blocks_in_tile(s.bounds, origin_x, origin_y);
  const int width = r.last_x - r.first_x + 1, height = r.last_y - r.first_y + 1;
  const float left_px = float((origin_x + r.first_x) * kBlockSide);
  int x = 0, block = r.first_y * kTileBlocks + r.first_x;
  float right_px = left_px, down_px = float((origin_y + r.first_y) * kBlockSide);
  // One loop over rows and columns: the processor guesses its end better than that of each row.
  for (int rest = width * height; rest > 0; --rest) {
    float(*rows)[kBlockPixels] = block_rows<kRows>(scratch, block);
    Wide t = load_wide(rows[kTransmittance]);
    if (is_open(t)) {
      visit(centres.x + right_px - Wide(s.mean_x), centres.y + down_px - Wide(s.mean_y), t, rows);
      store(t, rows[kTransmittance]);
    }
    const bool wrap = ++x == width;
    block += wrap ? kTileBlocks + 1 - width : 1;
    right_px = wrap ? left_px : right_px + kBlockSide;
    down_px += wrap ? float(kBlockSide) : 0.0f;
    x = wrap ? 0 : x;
  }
}

// Calls visit(Gaussian, its slot) front to back, and clears the slots behind an opaque tile.
template <int kRows, class Visit>
static RGBAVATAR_MEMBER void for_gaussians(const Tile& tile, TileScratch& scratch, float* slots,
                                           int slot_width, Visit visit) {
  bool open = true;
  for (uint32_t first = 0; first < tile.entry_count; first += kPortion) {
    const int count = load_portion(tile, first, scratch);
    open = open && any_open<kRows>(scratch);
    for (int i = 0; i < count; ++i) {
      const Splat& s = scratch.portion[i];
      float* slot = slots + int64_t(tile.slot(s)) * slot_width;
      if (open)
        visit(s, slot);
      else
        for (int k = 0; k < slot_width; ++k) slot[k] = 0.0f;
    }
  }
}

static void load_color_block(const Tile& tile, const float* image, const BlockPixels& pixels,
                             float channels[3][kBlockPixels]) {
  if (pixels.whole()) {
    for (int y = 0; y < kBlockSide; ++y) {
      Quad r, g, b;
      load_interleaved(image + (pixels.first + y * tile.width) * 3, r, g, b);
      store_quad(r, channels[0] + y * kBlockSide);
      store_quad(g, channels[1] + y * kBlockSide);
      store_quad(b, channels[2] + y * kBlockSide);
    }
  } else {
    for (int k = 0; k < 3; ++k) store(Wide(0.0f), channels[k]);
    pixels.for_each(tile, [&](int lane, int64_t pixel) {
      for (int k = 0; k < 3; ++k) channels[k][lane] = image[pixel * 3 + k];
    });
  }
}

// Sets the remainder to g . image - h (1 - alpha) and the channels to g; both are 0 outside the
// image.
static void start_remainder(const Tile& tile, const BackwardInput& in, TileScratch& scratch) {
  for (int block = 0; block < kBlocksPerTile; ++block) {
    float(*rows)[kBlockPixels] = block_rows<kBlendRows>(scratch, block);
    float(*g)[kBlockPixels] = rows + kColor;
    float* remainder = rows[kRemainder];
    const BlockPixels pixels(tile, block);
    Wide rest(0.0f);
    if (in.image_grad) {
      float image[3][kBlockPixels];
      load_color_block(tile, in.image, pixels, image);
      load_color_block(tile, in.image_grad, pixels, g);
      for (int k = 0; k < 3; ++k) rest = rest + load_wide(g[k]) * load_wide(image[k]);
    }
    store(rest, remainder);
    if (in.alpha_grad)
      pixels.for_each(tile, [&](int lane, int64_t pixel) {
        remainder[lane] -= in.alpha_grad[pixel] * (1.0f - in.alpha[pixel]);
      });
  }
}

static void backward_tile(const Tile& tile, const BackwardInput& in, TileScratch& scratch,
                          float* slots) {
  const PixelCentres centres;
  start_rows<kBlendRows>(tile, scratch);
  start_remainder(tile, in, scratch);
  for_gaussians<kBlendRows>(tile, scratch, slots, kMoments, [&](const Splat& s, float* slot) {
    Wide sums[kMoments];
    for (int k = 0; k < kMoments; ++k) sums[k] = Wide(0.0f);
    for_open_blocks<kBlendRows>(
        tile, centres, s, scratch,
        [&](const Wide& dx, const Wide& dy, Wide& t, float(*rows)[kBlockPixels]) {
          const Wide red = load_wide(rows[kColor]), green = load_wide(rows[kColor + 1]);
          const Wide blue = load_wide(rows[kColor + 2]);
          const Alpha alpha = alpha_at(dx, dy, s);
          const Wide w = alpha.value * t;
          const Wide along = red * s.red + green * s.green + blue * s.blue;
          const Wide remainder = load_wide(rows[kRemainder]) - w * along;
          store(remainder, rows[kRemainder]);
          const Wide d_alpha = t * along - remainder * reciprocal_of(1.0f - alpha.value);
          t = t - w;
          // The cap has no gradient.
          const Wide raw = select(alpha.raw <= Wide(C::kMaxAlpha), alpha.raw, Wide(0.0f));
          const Wide d_p = d_alpha * raw;  // times ln 2, below
          const Wide d_x = d_p * dx, d_y = d_p * dy;
          sums[0] = sums[0] + w * red;
          sums[1] = sums[1] + w * green;
          sums[2] = sums[2] + w * blue;
          sums[3] = sums[3] + d_p;
          sums[4] = sums[4] + d_x;
          sums[5] = sums[5] + d_y;
          sums[6] = sums[6] + d_x * dx;
          sums[7] = sums[7] + d_x * dy;
          sums[8] = sums[8] + d_y * dy;
        });
    store_quad(sums_of(sums[0], sums[1], sums[2], sums[3]) * Quad{1.0f, 1.0f, 1.0f, C::kLn2}, slot);
    store_quad(sums_of(sums[4], sums[5], sums[6], sums[7]) * C::kLn2, slot + 4);
    slot[8] = sum_of(sums[8]) * C::kLn2;
  });
}

template <int kChannels>
static void average_channels(const Tile& tile, const float* image, int channels,
                             TileScratch& scratch, float* slots) {
  const PixelCentres centres;
  constexpr int kRows = 1 + kChannels;
  start_rows<kRows>(tile, scratch);
  for (int block = 0; block < kBlocksPerTile; ++block) {
    float(*values)[kBlockPixels] = block_rows<kRows>(scratch, block) + 1;
    BlockPixels(tile, block).for_each(tile, [&](int lane, int64_t pixel) {
      for (int k = 0; k < channels; ++k) values[k][lane] = image[pixel * channels + k];
    });
  }
  for_gaussians<kRows>(tile, scratch, slots, channels + 2, [&](const Splat& s, float* slot) {
    Wide sums[kChannels + 1], largest(0.0f);
    for (int k = 0; k <= kChannels; ++k) sums[k] = Wide(0.0f);
    for_open_blocks<kRows>(
        tile, centres, s, scratch,
        [&](const Wide& dx, const Wide& dy, Wide& t, const float(*rows)[kBlockPixels]) {
          const Wide w = alpha_at(dx, dy, s).value * t;
          t = t - w;
          largest = max_of(largest, w);
          sums[kChannels] = sums[kChannels] + w;
          for (int k = 0; k < kChannels; ++k) sums[k] = sums[k] + w * load_wide(rows[1 + k]);
        });
    for (int k = 0; k < channels; ++k) slot[k] = sum_of(sums[k]);
    slot[channels] = sum_of(sums[kChannels]);
    slot[channels + 1] = max_lane(largest);
  });
}

static void average_tile(const Tile& tile, const float* image, int channels, TileScratch& scratch,
                         float* slots) {
  if (channels == 0)
    average_channels<0>(tile, image, channels, scratch, slots);
  else if (channels <= 4)
    average_channels<4>(tile, image, channels, scratch, slots);
  else
    average_channels<kMaxChannels>(tile, image, channels, scratch, slots);
}

extern const Kernels kernels;
const Kernels kernels = {project_image, forward_tile, backward_tile, average_tile,
                         project_image_backward};

}  // namespace rgbavatar::RGBAVATAR_ISA
