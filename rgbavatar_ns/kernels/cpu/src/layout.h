// The data that the driver and the per-instruction-set loops share.
#pragma once

#include <cstddef>
#include <cstdint>

namespace rgbavatar {

// Pixels are taken in blocks of 4 x 4, one SIMD vector, and blocks in tiles.
constexpr int kBlockSide = 4;
constexpr int kBlockPixels = 16;
constexpr int kTileBlocksShift = 3;
constexpr int kTileBlocks = 1 << kTileBlocksShift;
constexpr int kBlocksPerTile = kTileBlocks * kTileBlocks;
constexpr int kMaxChannels = 8;
// A Gaussian whose blocks fit this window knows which of them its ellipse touches.
constexpr int kWindow = 8;

// Blocks first..last (inclusive) that hold every pixel a Gaussian can reach.
struct Bounds {
  uint16_t first_block_x, first_block_y, last_block_x, last_block_y;
};

// A projected Gaussian, as the blending wants it: one cache line.
struct alignas(64) Splat {
  float mean_x, mean_y, log2_opacity, qa, qb, qc;
  float red, green, blue, depth;
  Bounds bounds;
  uint64_t blocks;  // bit 8 y + x: it touches the block (x, y) counted from the first one of the
                    // bounds; kAllBlocks where the bounds do not fit the window
  uint32_t first_slot;  // of its sums: one for every tile that it touches, row by row
  uint32_t index;  // its number
};
constexpr uint64_t kAllBlocks = ~uint64_t(0);

// [B or 1, N, width] floats; the stride is 0 when the batch shares them.
struct Attribute {
  const float* data;
  int64_t batch_stride;
  const float* of(int image) const { return data + image * batch_stride; }
};

struct Scene {
  int batch, count, width, height;
  Attribute means, quats, scales, opacities, colors;
  Attribute screen_offset;  // [B, N, 2], px that the projected means move by; null: none does
};

// Gradients like the attributes; that of the offset is null where the scene has none.
struct SceneGradient {
  float *means, *quats, *scales, *opacities, *colors, *screen_offset;
};

// Which tiles a Gaussian touches: the first one << 2, and whether those to the right and below are
// among them; kManyTiles where others are, which its bounds tell; the number past the last tile << 2
// where it is out of sight.
constexpr uint32_t kTileRight = 1, kTileBelow = 2, kManyTiles = ~uint32_t(0);
constexpr int kTileShift = 2;

// Where the projection of one image goes.
struct Projected {
  Splat* splats;    // those out of sight hold anything
  float* depth;     // the same again in an array, for the sorting
  uint32_t* tiles;  // which they touch
  int tiles_x, tile_count;
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
  const uint64_t* entries;  // front to back: the Gaussian is the lower half
  uint32_t entry_count;
  int tile_x, tile_y, width, height;
};

struct ForwardOutput {
  const float* background;
  float *image, *alpha, *depth;  // of one image; depth may be null
};

struct BackwardInput {
  const float* background;
  const float *image_grad, *alpha_grad;  // of one image; each may be null
};

// Gaussians of a tile that are taken together, and which of its blocks they touch.
constexpr int kGroupSplats = 64;
constexpr int kNoLimit = 1 << 30;
struct alignas(64) Group {
  Splat splats[kGroupSplats];
  uint64_t blocks[kGroupSplats];        // by Gaussian: the blocks
  uint64_t touching[kBlocksPerTile];  // by block: the Gaussians
  uint32_t first_job[kGroupSplats];
  int count, jobs, kept_from;
};

// What the blending keeps of jobs for the sums over pixels.
struct Kept {
  float (*alpha)[kBlockPixels], (*weight)[kBlockPixels];
};

// A Gaussian that waits for its first colour, as a tile shows it: what it counts there is summed at
// once where that is well enough, else only if another tile shows it so, which is rare.
struct Sighting {
  uint64_t blocks;  // of the tile
  uint32_t index;
  float most;     // its largest weight there
  float sums[4];  // of red, green, blue and weight
  int64_t tile;   // the batch's tiles counted through
  bool summed;
};

// Where a group begins that was not kept.
struct alignas(64) Checkpoint {
  float transmittance[kBlocksPerTile][kBlockPixels];
  uint32_t entry;
};

// Scratch memory of one thread: what a pass keeps for every block, a few rows each, the
// transmittance first; groups with their jobs, and room for one more that is made again.
constexpr int kKeptGroups = 128, kKeptJobs = 24576, kKeptSightings = 128;
struct alignas(64) TileScratch {
  float rows[kBlocksPerTile * (1 + kMaxChannels)][kBlockPixels];
  float alpha[kKeptJobs + kGroupSplats * kBlocksPerTile][kBlockPixels];
  float weight[kKeptJobs + kGroupSplats * kBlocksPerTile][kBlockPixels];
  Group groups[kKeptGroups + 1];
  float counted[kBlocksPerTile * 4][kBlockPixels];  // what each pixel counts for a first colour
  Sighting sightings[kKeptSightings];               // those not yet handed over
  Checkpoint* checkpoints;  // one for every kGroupSplats entries of the fullest tile, and one
};

// ---- Morphed Gaussians ------------------------------------------------------------------------

// Position, rotation and colour: what the bases change.
constexpr int kMorphedKinds = 3;
enum { kPositionKind, kRotationKind, kColorKind };
constexpr int kMorphedWidth[kMorphedKinds] = {3, 4, 3};
// Gaussians that are morphed at a time: many, because each basis is a stretch of memory of its own,
// which a processor has to find first; the columns of a batch still fit the second cache.
constexpr int kBlendChunk = 1024;
constexpr int kBlendColumns = kBlendChunk * 4;

// A triangle's frame, corner, edges and length ratio in an image: 23 numbers, and one unused.
constexpr int kFrameFloats = 24;

// What the gradient of a Gaussian's frame is made of, in an image: the gradients of its mean, of
// the frame's rotation and of the length ratio, and its tangent position; one number is unused.
constexpr int kCarriedFloats = 12;

// Gaussians in the tangent frames of a mesh, as base plus weighted bases (paper, eq. 1), for a
// batch of meshes.
struct MorphedScene {
  int batch, count, bases, width, height;
  int vertices, triangles, variant;  // variant: TangentVariant
  const float* weights;              // [B, K]
  const float* base[kMorphedKinds];   // [N, 3 or 4]
  const float* basis[kMorphedKinds];  // [K, N, 3 or 4]
  const float *log_scale, *opacity_logit;  // [N, 3], [N]
  const float *vertex, *barycentric;       // [B, V, 3], [N, 3]
  const int64_t *triangle_vertices, *triangle_of;  // [U, 3], [N]
  const float *edges_to_frame, *rest_length;       // [U, 4], [U]; no rest length: fixed scales
  float* frames;                                   // [B, U, kFrameFloats]
};

// Parameters with Adam's moments, and the numbers of this step.
struct AdamGroup {
  float *value, *first, *second;
  float rate, inverse_root, beta1, beta2, epsilon;
};

struct MorphedOptimizer {
  AdamGroup base[kMorphedKinds], basis[kMorphedKinds], log_scale, opacity_logit;
};

// Scratch memory of one thread for a chunk of Gaussians.
struct BlendScratch {
  float* tangent[kMorphedKinds];   // [B, kBlendChunk * width]: morphed, or the gradient of that
  float* weight_sums;              // [B, K, 16]
  float gradient[kBlendColumns];
  float scale[3][kBlendChunk], opacity[kBlendChunk];
  float scale_gradient[kBlendChunk * 3], opacity_gradient[kBlendChunk];
};

// What is summed for the Gaussians that wait for their first colour, in whole numbers, so that the
// order in which tiles and pictures add to them does not matter.
struct FirstSight {
  const bool* known;     // [N]: those that do not wait
  int64_t* sums;         // [N, kSightSums]: red, green, blue, weight; the largest weight
  float threshold;       // of the largest weight: what stays below it has no sums
  float log2_threshold;  // whose opacity is not above it is passed over
  int images;            // how many pictures count, from the first on
  bool over_background;  // the picture as it is drawn over, or what its matte leaves of it
};
constexpr int kSightSums = 5;
constexpr float kSightUnit = 4294967296.0f;  // 2^32: sums stay below 2^63 in any picture

// Where sightings go.
struct Sightings {
  Sighting* seen;  // room for all pairs of a Gaussian and a tile
  int64_t count;
};

// A tile's target for training: straight-alpha RGBA of 8 bits over the background.
struct TrainingTarget {
  const uint8_t* rgba;
  const float* background;
  float gradient;  // of the loss by each absolute difference
  const FirstSight* sight;  // null where no first colours are asked for
  Sightings* sightings;     // what is found then
  int64_t tile;
};

struct PackedScene;  // packed_layout.h
struct PosedMesh;    // posing_layout.h
struct SimilarityScene;  // similarity_layout.h
struct HarmonicScene;    // harmonics_layout.h

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
  // Fills the frames [begin, end) of an image.
  void (*fill_frames)(const MorphedScene&, int image, int begin, int end);
  // Morphs and projects Gaussians [begin, end), at most kBlendChunk, of all images. `cameras` and
  // `images` hold one entry an image.
  void (*project_morphed)(const MorphedScene&, const float* cameras, int begin, int end,
                          BlendScratch&, const Projected* images);
  // Draws the tile, compares it with the target and writes its slots; returns the sum of absolute
  // differences.
  double (*train_tile)(const Tile&, const TrainingTarget&, TileScratch&, float* slots);
  // Fills the sums of `count` sightings, all of this tile.
  void (*see_tile)(const Tile&, const TrainingTarget&, TileScratch&, Sighting*, int count);
  // Updates the parameters of Gaussians [begin, end), where there is an optimizer, and writes the
  // gradient of the weights that comes from them, [B, K], and, where it is asked for, what
  // `mesh_gradient` needs of them, [B, N, kCarriedFloats].
  void (*update_morphed)(const MorphedScene&, const float* cameras, int begin, int end,
                         BlendScratch&, const ImageSlots* images, const MorphedOptimizer*,
                         float* weight_gradient, float* carried);
  // Writes the gradient of an image's vertices, [V, 3]; `frame_gradient` is scratch memory for
  // [U, kFrameFloats].
  void (*mesh_gradient)(const MorphedScene&, int image, const float* carried,
                        float* frame_gradient, float* vertex_gradient);
  // Morphs and projects the packed Gaussians [begin, end), whole blocks.
  void (*project_packed)(const PackedScene&, const float* camera, int begin, int end,
                         const Projected&);
  // Writes the vertices [V, 3] of the blocks [begin, end).
  void (*pose_vertices)(const PosedMesh&, int begin, int end, float* vertices);
  // Returns the sum of SSIM over the rows [begin, end) of windows, and writes their slopes where
  // they are wanted; `scratch` has similarity_scratch floats.
  double (*similarity_rows)(const SimilarityScene&, int begin, int end, float* scratch);
  // Writes the rows [begin, end) of the gradient by x from all slopes.
  void (*similarity_gradient_rows)(const SimilarityScene&, int begin, int end, float* scratch,
                                   float* gradient);
  // Writes the colours of Gaussians [begin, end) in all images.
  void (*harmonic_colors)(const HarmonicScene&, int begin, int end, float* colors);
  // Writes the gradients of their coefficients, summed where images share them, and directions.
  void (*harmonic_gradient)(const HarmonicScene&, int begin, int end, const float* color_gradient,
                            float* coefficient_gradient, float* direction_gradient);
};

// world_to_camera [4, 4], focal [2] and principal point [2] in one row of floats.
constexpr int kCameraFloats = 20;

}  // namespace rgbavatar
