// Passes that sum over pixels for each Gaussian of a tile: gradients and weighted averages.
#pragma once

#include "forward_tile.h"

namespace rgbavatar::RGBAVATAR_ISA {

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

}  // namespace rgbavatar::RGBAVATAR_ISA
