// The data that the driver and the per-instruction-set loops share.
#pragma once

#include <cstdint>

namespace rgbavatar {

// Pixels are taken in blocks of 4 x 4, one SIMD vector, and blocks in tiles.
constexpr int kBlockSide = 4;
constexpr int kBlockPixels = 16;
constexpr int kTileBlocksShift = 4;
constexpr int kTileBlocks = 1 << kTileBlocksShift;
constexpr int kBlocksPerTile = kTileBlocks * kTileBlocks;
constexpr int kMaxChannels = 8;
// A Gaussian whose blocks fit this window knows which of them its ellipse touches.
constexpr int kWindow = 8;

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
  uint64_t blocks;  // bit 8 y + x: it touches the block (x, y) counted from the first one of the
                    // bounds; kAllBlocks where the bounds do not fit the window
  uint64_t unused;
};
constexpr uint64_t kAllBlocks = ~uint64_t(0);

// A Gaussian in a tile, and where its gradient's sums over the tile's pixels go.
struct Entry {
  uint32_t gaussian, slot;
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

// Gradients like the attributes.
struct SceneGradient {
  float *means, *quats, *scales, *opacities, *colors;
};

// Where the projection of one image goes.
struct Projected {
  Splat* splats;    // those out of sight hold anything
  float* depth;     // the same again in arrays, for the sorting
  Bounds* bounds;
};

// The nine sums of the blending's backward pass, in the order of Moments.
constexpr int kMoments = 9;

// What one image left behind for its Gaussians' gradients.
struct ImageSlots {
  const uint32_t* offset;  // [N + 1]: first slot of every Gaussian
  const float* slots;      // [slots, kMoments], and room for three floats more
};

// One tile of one image.
struct Tile {
  const Splat* splats;
  const Entry* entries;  // front to back
  uint32_t entry_count;
  int tile_x, tile_y, width, height;
};

struct ForwardOutput {
  const float* background;
  float *image, *alpha, *depth;  // of one image; depth may be null
};

struct BackwardInput {
  const float *image, *alpha;            // the forward result
  const float *image_grad, *alpha_grad;  // each may be null
};

// Gaussians of a tile that are taken together. Each has some jobs: blocks of pixels.
constexpr int kGroupSplats = 64, kGroupJobs = 192;
struct alignas(64) Group {
  Splat splats[kGroupSplats];
  float alpha[kGroupJobs + 4][kBlockPixels], odds[kGroupJobs + 4][kBlockPixels];
  uint32_t jobs[kGroupJobs + kBlockPixels];  // place of the Gaussian << 16 | block of the tile
  uint32_t first_job[kGroupSplats + 1];
  uint32_t slot[kGroupSplats];
  bool continued[kGroupSplats];  // it had jobs in earlier groups
  int splat_count, job_count;
};

// Scratch memory of one thread: what a pass keeps for every block, a few rows each, the
// transmittance first.
struct alignas(64) TileScratch {
  float rows[kBlocksPerTile * (1 + kMaxChannels)][kBlockPixels];
  Group group;
};

// The loops, compiled once per instruction set.
struct Kernels {
  // Projects Gaussians [begin, end) of an image.
  void (*project)(const Scene&, const float* camera, int image, int begin, int end,
                  const Projected&);
  void (*forward_tile)(const Tile&, const ForwardOutput&, TileScratch&);
  // Writes slots[slot * kMoments].
  void (*backward_tile)(const Tile&, const BackwardInput&, TileScratch&, float* slots);
  // Writes slots[slot * (channels + 2)]: sums of w I, sum of w, largest w. `image` is [H, W, C].
  void (*average_tile)(const Tile&, const float* image, int channels, TileScratch&, float* slots);
  // Writes the gradient of image `image` for Gaussians [begin, end); adds to that of the images
  // before where the batch shares an attribute.
  void (*project_backward)(const Scene&, const float* camera, int image, int begin, int end,
                           const ImageSlots&, const SceneGradient&);
};

// world_to_camera [4, 4], focal [2] and principal point [2] in one row of floats.
constexpr int kCameraFloats = 20;

}  // namespace rgbavatar
