// Passes that sum over pixels for each Gaussian of a tile: gradients and weighted averages.
#pragma once

#include "forward_tile.h"

namespace rgbavatar::RGBAVATAR_ISA {

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

// Begins to fetch the block two below, whose rows lie too far apart for the processor to guess.
static void prefetch_block(const Tile& tile, const float* image, const BlockPixels& pixels) {
  for (int y = 0; y < kBlockSide; ++y)
    __builtin_prefetch(image + (pixels.first + (2 * kBlockSide + y) * int64_t(tile.width)) * 3);
}

// Sets the channels to g = dL/dimage and `behind` to g . background - dL/dalpha; all are 0 outside
// the image.
static void start_gradient(const Tile& tile, const BackwardInput& in, TileScratch& scratch) {
  for (int block = 0; block < kBlocksPerTile; ++block) {
    float(*rows)[kBlockPixels] = block_rows<kBlendRows>(scratch, block);
    float(*g)[kBlockPixels] = rows + kColor;
    const BlockPixels pixels(tile, block);
    Wide behind(0.0f);
    if (in.image_grad) {
      prefetch_block(tile, in.image_grad, pixels);
      load_color_block(tile, in.image_grad, pixels, g);
      for (int k = 0; k < 3; ++k) behind = behind + load_wide(g[k]) * in.background[k];
    } else {
      for (int k = 0; k < 3; ++k) store(Wide(0.0f), g[k]);
    }
    store(behind, rows[kBehind]);
    if (in.alpha_grad)
      pixels.for_each(tile, [&](int lane, int64_t pixel) {
        rows[kBehind][lane] -= in.alpha_grad[pixel];
      });
  }
}

// Where a Gaussian's sums over a tile go.
static RGBAVATAR_MEMBER float* slot_of(const Tile& tile, const Splat& s, float* slots, int width) {
  const int first_x = s.bounds.first_block_x >> kTileBlocksShift;
  const int first_y = s.bounds.first_block_y >> kTileBlocksShift;
  const int across = (s.bounds.last_block_x >> kTileBlocksShift) - first_x + 1;
  const int place = (tile.tile_y - first_y) * across + tile.tile_x - first_x;
  return slots + (int64_t(s.first_slot) + place) * width;
}

static void clear_slot(const Tile& tile, const Splat& s, float* slots, int width) {
  float* slot = slot_of(tile, s, slots, width);
  for (int k = 0; k < width; ++k) slot[k] = 0.0f;
}

// Where pixel (0, 0) of a block is, from that of the tile's first block.
struct BlockOffsets {
  float x[kBlocksPerTile], y[kBlocksPerTile];
  constexpr BlockOffsets() : x(), y() {
    for (int block = 0; block < kBlocksPerTile; ++block) {
      x[block] = float(block % kTileBlocks * kBlockSide);
      y[block] = float(block / kTileBlocks * kBlockSide);
    }
  }
};
static constexpr BlockOffsets kBlockOffsets = {};

// The sums over the jobs of one Gaussian of the group, which are written to its slot. Then it stands
// behind those in front of it. Returns each lane's largest weight, if that is asked for.
template <bool kLargest>
static RGBAVATAR_MEMBER Wide sum_moments(const Tile& tile, const BlockGrid& grid,
                                         const Group& group, int place, const Kept& kept,
                                         TileScratch& scratch, float* slots) {
  const Splat& s = group.splats[place];
  const Wide color_red(s.red), color_green(s.green), color_blue(s.blue);
  const Wide zero(0.0f);
  const Wide x = load_wide(grid.x[0]) - s.mean_x, y = load_wide(grid.y[0]) - s.mean_y;
  Wide sum_red = zero, sum_green = zero, sum_blue = zero;
  Wide largest = zero, sum_one = zero, sum_x = zero, sum_y = zero, sum_xx = zero, sum_xy = zero, sum_yy = zero;
  const float *alpha_row = kept.alpha[group.first_job[place]],
              *weight_row = kept.weight[group.first_job[place]];
  for (uint64_t left = group.blocks[place]; left; left &= left - 1) {
    const int block = __builtin_ctzll(left);
    float* row = block_rows<kBlendRows>(scratch, block)[0];
    const Wide red = load_wide(row + kColor * kBlockPixels);
    const Wide green = load_wide(row + (kColor + 1) * kBlockPixels);
    const Wide blue = load_wide(row + (kColor + 2) * kBlockPixels);
    const Wide behind = load_wide(row + kBehind * kBlockPixels);
    const Wide alpha = load_wide(alpha_row), w = load_wide(weight_row);
    if (kLargest) largest = max_of(largest, w);
    const Wide more = red * color_red + green * color_green + blue * color_blue - behind;
    store(behind + alpha * more, row + kBehind * kBlockPixels);
    // alpha dL/dalpha, whose ln 2 follows below; the cap has no gradient.
    const Wide d_p = select(Wide(C::kMaxAlpha) > alpha, w * more, zero);
    const Wide dx = x + kBlockOffsets.x[block], dy = y + kBlockOffsets.y[block];
    const Wide d_x = d_p * dx, d_y = d_p * dy;
    sum_red = sum_red + w * red;
    sum_green = sum_green + w * green;
    sum_blue = sum_blue + w * blue;
    sum_one = sum_one + d_p;
    sum_x = sum_x + d_x;
    sum_y = sum_y + d_y;
    sum_xx = sum_xx + d_x * dx;
    sum_xy = sum_xy + d_x * dy;
    sum_yy = sum_yy + d_y * dy;
    alpha_row += kBlockPixels;
    weight_row += kBlockPixels;
  }
  float* slot = slot_of(tile, s, slots, kMoments);
  const Quad units = {1.0f, 1.0f, 1.0f, C::kLn2};
  store_quad(sums_of(sum_red, sum_green, sum_blue, sum_one) * units, slot);
  store_quad(sums_of(sum_x, sum_y, sum_xx, sum_xy) * C::kLn2, slot + 4);
  slot[8] = sum_of(sum_yy) * C::kLn2;
  return largest;
}

static void sum_group(const Tile& tile, const BlockGrid& grid, const Group& group, const Kept& kept,
                      TileScratch& scratch, float* slots) {
  for (int i = group.count; i-- > 0;)
    sum_moments<false>(tile, grid, group, i, kept, scratch, slots);
}

static void backward_tile(const Tile& tile, const BackwardInput& in, TileScratch& scratch,
                          float* slots) {
  const BlockGrid grid(tile);
  KeptGroups<kBlendRows> groups;
  start_rows<kBlendRows>(tile, scratch);
  groups.template blend<false>(tile, grid, scratch,
                      [&](const Splat& s) { clear_slot(tile, s, slots, kMoments); });
  start_gradient(tile, in, scratch);
  groups.visit_back_to_front(tile, grid, scratch, [&](const Group& group, const Kept& kept) {
    sum_group(tile, grid, group, kept, scratch, slots);
  });
}

template <int kChannels>
static RGBAVATAR_MEMBER void sum_channels(const Tile& tile, const Group& group, int place,
                                          const Kept& kept, int channels, TileScratch& scratch,
                                          float* slots) {
  Wide sums[kChannels + 1], largest(0.0f);
  for (int k = 0; k <= kChannels; ++k) sums[k] = Wide(0.0f);
  const float* weight_row = kept.weight[group.first_job[place]];
  for (uint64_t left = group.blocks[place]; left; left &= left - 1) {
    const float* row = block_rows<1 + kChannels>(scratch, __builtin_ctzll(left))[0];
    const Wide w = load_wide(weight_row);
    largest = max_of(largest, w);
    sums[kChannels] = sums[kChannels] + w;
    for (int k = 0; k < kChannels; ++k)
      sums[k] = sums[k] + w * load_wide(row + (1 + k) * kBlockPixels);
    weight_row += kBlockPixels;
  }
  float* slot = slot_of(tile, group.splats[place], slots, channels + 2);
  for (int k = 0; k < channels; ++k) slot[k] = sum_of(sums[k]);
  slot[channels] = sum_of(sums[kChannels]);
  slot[channels + 1] = max_lane(largest);
}

template <int kChannels>
static void average_channels(const Tile& tile, const float* image, int channels,
                             TileScratch& scratch, float* slots) {
  const BlockGrid grid(tile);
  constexpr int kRows = 1 + kChannels;
  start_rows<kRows>(tile, scratch);
  for (int block = 0; block < kBlocksPerTile; ++block) {
    float(*values)[kBlockPixels] = block_rows<kRows>(scratch, block) + 1;
    BlockPixels(tile, block).for_each(tile, [&](int lane, int64_t pixel) {
      for (int k = 0; k < channels; ++k) values[k][lane] = image[pixel * channels + k];
    });
  }
  KeptGroups<kRows> groups;
  groups.template blend<false>(tile, grid, scratch, [&](const Splat& s) {
    clear_slot(tile, s, slots, channels + 2);
  });
  groups.visit_back_to_front(tile, grid, scratch, [&](const Group& group, const Kept& kept) {
    for (int i = 0; i < group.count; ++i)
      sum_channels<kChannels>(tile, group, i, kept, channels, scratch, slots);
  });
}

static void average_tile(const Tile& tile, const float* image, int channels, TileScratch& scratch,
                         float* slots) {
  if (channels == 0)
    average_channels<0>(tile, image, channels, scratch, slots);
  else if (channels == 1)
    average_channels<1>(tile, image, channels, scratch, slots);
  else if (channels <= 4)
    average_channels<4>(tile, image, channels, scratch, slots);
  else
    average_channels<kMaxChannels>(tile, image, channels, scratch, slots);
}

}  // namespace rgbavatar::RGBAVATAR_ISA
