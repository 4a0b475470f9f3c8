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
  if (!image) return;
  for (int y = 0; y < kBlockSide; ++y)
    __builtin_prefetch(image + (pixels.first + (2 * kBlockSide + y) * int64_t(tile.width)) * 3);
}

// Sets the remainder to g . image - h (1 - alpha) and the channels to g; both are 0 outside the
// image.
static void start_remainder(const Tile& tile, const BackwardInput& in, TileScratch& scratch) {
  for (int block = 0; block < kBlocksPerTile; ++block) {
    float(*rows)[kBlockPixels] = block_rows<kBlendRows>(scratch, block);
    float(*g)[kBlockPixels] = rows + kColor;
    float* remainder = rows[kRemainder];
    const BlockPixels pixels(tile, block);
    prefetch_block(tile, in.image, pixels);
    prefetch_block(tile, in.image_grad, pixels);
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

static void clear_slot(float* slots, uint32_t slot, int width) {
  for (int k = 0; k < width; ++k) slots[int64_t(slot) * width + k] = 0.0f;
}

// The sums over the jobs of one Gaussian of the group, which are written to its slot.
static RGBAVATAR_MEMBER void sum_moments(const BlockGrid& grid, const Group& group, int place,
                                         TileScratch& scratch, float* slots) {
  const Splat& s = group.splats[place];
  const Wide color_red(s.red), color_green(s.green), color_blue(s.blue);
  const Wide zero(0.0f);
  Wide sum_red = zero, sum_green = zero, sum_blue = zero;
  Wide sum_one = zero, sum_x = zero, sum_y = zero, sum_xx = zero, sum_xy = zero, sum_yy = zero;
  const int stop = int(group.first_job[place + 1]);
  for (int i = int(group.first_job[place]); i < stop; ++i) {
    const unsigned block = Job(group, i).block;
    float* row = block_rows<kBlendRows>(scratch, block)[0];
    const Wide t = load_wide(row);
    if (!is_open(t)) continue;
    const Wide red = load_wide(row + kColor * kBlockPixels);
    const Wide green = load_wide(row + (kColor + 1) * kBlockPixels);
    const Wide blue = load_wide(row + (kColor + 2) * kBlockPixels);
    const Wide alpha = load_wide(group.alpha[i]);
    const Wide w = alpha * t;
    const Wide along = w * (red * color_red + green * color_green + blue * color_blue);
    const Wide remainder = load_wide(row + kRemainder * kBlockPixels) - along;
    store(t - w, row);
    store(remainder, row + kRemainder * kBlockPixels);
    // alpha dL/dalpha, whose ln 2 follows below; the cap has no gradient.
    const Wide d_p = select(Wide(C::kMaxAlpha) > alpha,
                            along - remainder * load_wide(group.odds[i]), zero);
    const Wide dx = grid.from_mean_x(s, block), dy = grid.from_mean_y(s, block);
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
  }
  Quad first = sums_of(sum_red, sum_green, sum_blue, sum_one) * Quad{1.0f, 1.0f, 1.0f, C::kLn2};
  Quad second = sums_of(sum_x, sum_y, sum_xx, sum_xy) * C::kLn2;
  float last = sum_of(sum_yy) * C::kLn2;
  float* slot = slots + int64_t(group.slot[place]) * kMoments;
  if (group.continued[place]) {
    first = first + load_quad(slot);
    second = second + load_quad(slot + 4);
    last += slot[8];
  }
  store_quad(first, slot);
  store_quad(second, slot + 4);
  slot[8] = last;
}

static void sum_group(const BlockGrid& grid, const Group& group, TileScratch& scratch,
                      float* slots) {
  for (int i = 0; i < group.splat_count; ++i) sum_moments(grid, group, i, scratch, slots);
}

// Reads on to the end, from rows that hold dL/dimage and the remainder.
static void sum_rest(const BlockGrid& grid, GroupReader& reader, TileScratch& scratch,
                     float* slots) {
  Group& group = scratch.groups[0];
  while (any_open<kBlendRows>(scratch) && reader.next(group)) {
    fill_alphas<true>(grid, group);
    sum_group(grid, group, scratch, slots);
  }
  reader.rest([&](uint32_t slot) { clear_slot(slots, slot, kMoments); });
}

static void backward_tile(const Tile& tile, const BackwardInput& in, TileScratch& scratch,
                          float* slots) {
  start_rows<kBlendRows>(tile, scratch);
  start_remainder(tile, in, scratch);
  GroupReader reader(tile);
  sum_rest(BlockGrid(tile), reader, scratch, slots);
}

template <int kChannels>
static RGBAVATAR_MEMBER void sum_channels(const Group& group, int place, int channels,
                                          TileScratch& scratch, float* slots) {
  Wide sums[kChannels + 1], largest(0.0f);
  for (int k = 0; k <= kChannels; ++k) sums[k] = Wide(0.0f);
  const int stop = int(group.first_job[place + 1]);
  for (int i = int(group.first_job[place]); i < stop; ++i) {
    float* row = block_rows<1 + kChannels>(scratch, Job(group, i).block)[0];
    const Wide t = load_wide(row);
    if (!is_open(t)) continue;
    const Wide w = load_wide(group.alpha[i]) * t;
    store(t - w, row);
    largest = max_of(largest, w);
    sums[kChannels] = sums[kChannels] + w;
    for (int k = 0; k < kChannels; ++k)
      sums[k] = sums[k] + w * load_wide(row + (1 + k) * kBlockPixels);
  }
  float* slot = slots + int64_t(group.slot[place]) * (channels + 2);
  if (!group.continued[place]) clear_slot(slots, group.slot[place], channels + 2);
  for (int k = 0; k < channels; ++k) slot[k] += sum_of(sums[k]);
  slot[channels] += sum_of(sums[kChannels]);
  const float lane = max_lane(largest);
  slot[channels + 1] = lane > slot[channels + 1] ? lane : slot[channels + 1];
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
  GroupReader reader(tile);
  Group& group = scratch.groups[0];
  while (any_open<kRows>(scratch) && reader.next(group)) {
    fill_alphas<false>(grid, group);
    for (int i = 0; i < group.splat_count; ++i)
      sum_channels<kChannels>(group, i, channels, scratch, slots);
  }
  reader.rest([&](uint32_t slot) { clear_slot(slots, slot, channels + 2); });
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

}  // namespace rgbavatar::RGBAVATAR_ISA
