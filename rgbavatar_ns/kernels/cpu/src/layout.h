// The data that the driver and the per-instruction-set loops share.
#pragma once

#include <cstdint>

namespace rgbavatar {

// Pixels are taken in blocks of 4 x 4, one SIMD vector, and blocks in tiles of 16 x 16.
constexpr int kBlockSide = 4;
constexpr int kTileBlocksShift = 4;
constexpr int kTileBlocks = 1 << kTileBlocksShift;
constexpr int kBlocksPerTile = kTileBlocks * kTileBlocks;
constexpr int kBlockPixels = 16;
// Gaussians of a tile are taken in portions, so that the block lists have a fixed size.
constexpr int kPortion = 512;
constexpr int kMaxChannels = 8;

// Blocks first..last (inclusive) that hold every pixel a Gaussian can reach.
struct Bounds {
  uint16_t first_block_x, first_block_y, last_block_x, last_block_y;

  bool visible() const { return first_block_x <= last_block_x; }
  int first_tile_x() const { return first_block_x >> kTileBlocksShift; }
  int first_tile_y() const { return first_block_y >> kTileBlocksShift; }
  int tiles_x() const { return (last_block_x >> kTileBlocksShift) - first_tile_x() + 1; }
  int tiles_y() const { return (last_block_y >> kTileBlocksShift) - first_tile_y() + 1; }
};

// A projected Gaussian, as the blending wants it: one cache line.
struct alignas(64) Splat {
  float mean_x, mean_y, log2_opacity, qa, qb, qc;
  float red, green, blue, depth;
  Bounds bounds;
  uint32_t first_slot;  // of its (Gaussian, tile) slots
};

// [B or 1, N, width] floats; the stride is 0 when the batch shares them.
struct Attribute {
  const float* data;
  int64_t batch_stride;
  const float* of(int image) const { return data + image * batch_stride; }
};

struct Scene {
  int batch, count, width, height;
  Attribute means, quats, scales, opacities, colors;
};

// Gradients like the attributes; a null pointer means not wanted.
struct SceneGradient {
  float *means, *quats, *scales, *opacities, *colors;
};

// The nine sums of the blending's backward pass, in the order of Moments.
constexpr int kMoments = 9;

// One tile of one image.
struct Tile {
  const Splat* splats;
  const uint32_t* entries;  // Gaussians in the tile, front to back
  uint32_t entry_count;
  int tile_x, tile_y, width, height;

  uint32_t slot(const Splat& s) const {
    return s.first_slot + (tile_y - s.bounds.first_tile_y()) * s.bounds.tiles_x() + tile_x -
           s.bounds.first_tile_x();
  }
};

struct ForwardOutput {
  const float* background;
  float *image, *alpha, *depth;  // of one image; depth may be null
};

struct BackwardInput {
  const float *image, *alpha;            // the forward result
  const float *image_grad, *alpha_grad;  // each may be null
};

// Scratch memory of one thread.
struct alignas(64) TileScratch {
  // What a pass keeps for every block, a few rows each, the transmittance first.
  float rows[kBlocksPerTile * (1 + kMaxChannels)][kBlockPixels];
  Splat portion[kPortion];
  uint16_t list[kBlocksPerTile][kPortion];  // of each block: places in the portion
  uint16_t list_size[kBlocksPerTile];
};

// The loops, compiled once per instruction set.
struct Kernels {
  // Writes splats[begin, end), but for their first slot, and bounds[begin, end) of an image.
  void (*project)(const Scene&, const float* camera, int image, int begin, int end, Splat* splats,
                  Bounds* bounds);
  void (*forward_tile)(const Tile&, const ForwardOutput&, TileScratch&);
  // Writes slots[slot * kMoments].
  void (*backward_tile)(const Tile&, const BackwardInput&, TileScratch&, float* slots);
  // Writes slots[slot * (channels + 2)]: sums of w I, sum of w, largest w. `image` is [H, W, C].
  void (*average_tile)(const Tile&, const float* image, int channels, TileScratch&, float* slots);
  // Adds the gradient of image `image` for Gaussians [begin, end) to `gradient`.
  void (*project_backward)(const Scene&, const float* camera, int image, int begin, int end,
                           const uint32_t* slot_offset, const float* slots,
                           const SceneGradient& gradient);
};

// world_to_camera [4, 4], focal [2] and principal point [2] in one row of floats.
constexpr int kCameraFloats = 20;

}  // namespace rgbavatar
