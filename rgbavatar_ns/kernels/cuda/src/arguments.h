// What every kernel is given: one structure each, named after it. Python reads this file
// (kernels/cuda/source.py): one field a line, pointers to plain types, nothing else.
//
// B images, N Gaussians, K bases, C channels, U triangles, V vertices, P = tiles of an image.

// The images and their tiles.
struct Frame {
  int batch;
  int count;   // Gaussians of an image
  int width;
  int height;
  int tiles_x;
  int tiles_y;
};

// Cameras, shared by the batch where the count is 1.
struct CameraArrays {
  const float* world_to_camera;     // [B or 1, 4, 4]
  const float* focal_px;            // [B or 1, 2]
  const float* principal_point_px;  // [B or 1, 2]
  int count;
};

// Gaussians by tile. `status` holds the entries that were needed, the slots that were needed (never
// fewer), whether they were more than the capacity, how many launches have seen that, and the
// slots that were taken, in 64 bits.
struct Bins {
  float* splats;         // [B, N, 12], see Splat
  uint32_t* slot_start;  // [B, N]: first (Gaussian, tile) slot of every Gaussian
  uint32_t* tile_count;  // [B, P]: 0 before the projection and, of lists that fit, after the scatter
  uint32_t* tile_start;  // [B P + 1]
  uint64_t* entries;     // [capacity]: depth << 32 | Gaussian
  uint32_t* status;      // [6]
  int capacity;          // of entries and of slots
};

// Gaussians in the tangent frames of a mesh, as base plus weighted bases (paper, eq. 1).
struct Morphed {
  const float* weights;              // [B, K]
  const float* position;             // [N, 3]
  const float* rotation;             // [N, 4]
  const float* color;                // [N, 3]
  const float* basis_position;       // [K, N, 3]
  const float* basis_rotation;       // [K, N, 4]
  const float* basis_color;          // [K, N, 3]
  const float* log_scale;            // [N, 3]
  const float* opacity_logit;        // [N]
  const float* barycentric;          // [N, 3]
  const int64_t* triangle_of;        // [N]
  const int64_t* triangle_vertices;  // [U, 3]
  const float* edges_to_frame;       // [U, 4]
  const float* rest_length;          // [U] or null: fixed scales
  const float* vertices;             // [B, V, 3]
  float* frames;                     // [B, U, 24]
  float* tangent_position;           // [B, N, 3], like the next two what `morph` has summed
  float* tangent_rotation;           // [B, N, 4]
  float* tangent_color;              // [B, N, 3]
  int bases;
  int triangles;
  int vertex_count;
  int variant;  // TangentVariant
};

// World-space Gaussians; a stride is 0 where the batch shares the attribute.
struct World {
  const float* means;      // [B or 1, N, 3]
  const float* quats;      // [B or 1, N, 4]
  const float* scales;     // [B or 1, N, 3]
  const float* opacities;  // [B or 1, N]
  const float* colors;     // [B or 1, N, 3]
  const float* screen_offset;  // [B, N, 2], px that the projected means move by, or null
  int means_shared;
  int quats_shared;
  int scales_shared;
  int opacities_shared;
  int colors_shared;
};

struct ProjectArguments {
  Frame frame;
  CameraArrays cameras;
  World world;
  Bins bins;
};

struct FramesArguments {
  Frame frame;
  Morphed blended;
};

struct MorphArguments {
  Frame frame;
  Morphed blended;
};

struct BlendArguments {
  Frame frame;
  CameraArrays cameras;
  Morphed blended;
  Bins bins;
};

struct ScanArguments {
  Frame frame;
  Bins bins;
};

struct ScatterArguments {
  Frame frame;
  Bins bins;
};

struct SortArguments {
  Frame frame;
  Bins bins;
};

struct DrawArguments {
  Frame frame;
  Bins bins;
  const float* background;  // [B or 1, 3]
  int background_shared;
  float* image;  // [B, H, W, 3]
  float* alpha;  // [B, H, W]
  float* depth;  // [B, H, W] or null
};

struct DifferentiateArguments {
  Frame frame;
  Bins bins;
  const float* image;           // [B, H, W, 3], as drawn
  const float* alpha;           // [B, H, W], as drawn
  const float* image_gradient;  // [B, H, W, 3] or null
  const float* alpha_gradient;  // [B, H, W] or null
  float* slots;                 // [capacity, 9]
};

struct TrainArguments {
  Frame frame;
  Bins bins;
  const uint8_t* images;    // [frames, H, W, 4], straight alpha
  const int64_t* image_of;  // [B]: which of them, or null: as they stand
  const float* background;  // [B or 1, 3]
  int background_shared;
  float gradient;           // of the loss by each absolute difference
  float* slots;             // [capacity, 9]
  float* loss;              // [B, P]: sums of absolute differences
  const uint8_t* known;     // [N]: 0 for what waits for its first colour; null where none is asked for
  int64_t* sight;           // [N, 5] for those, see FirstSight
  int sight_images;         // how many of the images count for it
  int over_background;
};

struct AverageArguments {
  Frame frame;
  Bins bins;
  const float* images;  // [B or 1, H, W, C] or null
  int images_shared;
  int channels;  // 0 to 8
  float* slots;  // [capacity, C + 2]
};

struct CollectArguments {
  Frame frame;
  Bins bins;
  const float* slots;   // [capacity, C + 2]
  int channels;
  float* weighted_sum;  // [B, N, C] or null
  float* weight_sum;    // [B, N] or null
  float* max_weight;    // [B, N]
};

struct ProjectBackwardArguments {
  Frame frame;
  CameraArrays cameras;
  World world;
  Bins bins;
  const float* slots;  // [capacity, 9]
  float* means;        // [B, N, 3], like the others the gradient of each image
  float* quats;        // [B, N, 4]
  float* scales;       // [B, N, 3]
  float* opacities;    // [B, N]
  float* colors;       // [B, N, 3]
  float* screen_offset;  // [B, N, 2] or null
};

struct BlendBackwardArguments {
  Frame frame;
  CameraArrays cameras;
  Morphed blended;
  Bins bins;
  const float* slots;    // [capacity, 9]
  float* position;       // [B, N, 3], like the others the gradient of each image
  float* rotation;       // [B, N, 4]
  float* color;          // [B, N, 3]
  float* log_scale;      // [B, N, 3]
  float* opacity_logit;  // [B, N]
  float* carried;        // [B, N, 12] or null: what the gradient of the frames is made of
};

struct FramesBackwardArguments {
  Frame frame;
  Morphed blended;
  const float* frame_gradient;  // [B, U, 24]
  float* corner_gradient;       // [B, U, 3, 3]
};

// A parameter, a column each of its numbers, and where it is what bases change, these.
struct Columns {
  int columns;            // 0: there is no such parameter
  int bases;              // K, or 0
  const float* gradient;  // [B, columns]
  float* base;            // [columns]
  float* base_first;      // Adam's moments; null where nothing is to be updated
  float* base_second;
  float* basis;           // [K, columns]
  float* basis_first;
  float* basis_second;
  const float* numbers;   // [2, 5]: of the base and of the bases, see AdamStep
  float* weight_sums;     // [blocks, B, K]: a block's part of the weights' gradient, or null
};

struct UpdateArguments {
  int batch;
  const float* weights;    // [B, K]
  const uint32_t* status;  // as in Bins: after an overflow nothing is updated
  Columns columns0;        // by the block's y, up to kUpdatedTogether
  Columns columns1;
  Columns columns2;
  Columns columns3;
  Columns columns4;
};
