// The driver: memory, threads and the order of the stages; the loops are in isa_kernels.cpp.
#pragma once

#if defined(__linux__)
#include <sys/mman.h>
#endif

#include <cstdlib>
#include <memory>
#include <new>
#include <string>
#include <vector>

#include "layout.h"

namespace rgbavatar {

// Memory that grows and is not initialised.
template <class T>
class Buffer {
 public:
  void reserve(size_t count) {
    if (count <= capacity_) return;
    constexpr size_t kHugePage = size_t(2) << 20;
    const size_t bytes = count * sizeof(T);
    void* memory = nullptr;
    if (posix_memalign(&memory, bytes < kHugePage ? 64 : kHugePage, bytes) != 0)
      throw std::bad_alloc();
#if defined(__linux__)
    // Gaussians are met in any order: with small pages, half of the time goes to finding pages.
    if (bytes >= kHugePage) madvise(memory, bytes, MADV_HUGEPAGE);
#endif
    data_.reset(static_cast<T*>(memory));
    capacity_ = count;
  }
  T* data() { return data_.get(); }
  const T* data() const { return data_.get(); }
  T& operator[](size_t i) { return data_.get()[i]; }
  const T& operator[](size_t i) const { return data_.get()[i]; }

 private:
  struct Free {
    void operator()(T* memory) const { std::free(memory); }
  };
  std::unique_ptr<T, Free> data_;
  size_t capacity_ = 0;
};

// What one rendering needs; returned to a small pool, because fresh pages cost as much as work.
struct Workspace {
  Buffer<float> cameras;         // [B, kCameraFloats]
  Buffer<uint32_t> slot_offset;  // [B, N + 1]: first (Gaussian, tile) slot of every Gaussian
  Buffer<uint32_t> tile_start;   // [B, tiles + 1]: into the image's entries
  Buffer<Splat> splats;                // [B, N]; those out of sight hold anything
  Buffer<size_t> slot_start;           // [B + 1]: their sums, each image's first slot
  Buffer<float> slots;
  Buffer<ImageSlots> image_slots;  // [B]
  Buffer<TileScratch> scratch;     // [threads]
  Buffer<Checkpoint> checkpoints;  // [threads, ...]: what the scratch memory points to
  uint32_t most_entries;           // of a tile
  // Of the projection.
  Buffer<float> depth;             // [B, N]
  Buffer<uint32_t> tiles;          // [B, N]
  Buffer<Projected> projected;     // [B]
  // Of the sorting.
  std::vector<Buffer<uint64_t>> entries;  // [B]: an image's Gaussians by tile, front to back
  Buffer<uint32_t> part_start;     // [B, parts, tiles + 1]: where a part's next entry of a tile goes
  Buffer<size_t> part_slots;       // [B, parts]: (Gaussian, tile) pairs
  Buffer<uint64_t> sort_keys;      // [threads, most entries of a tile]
  // Of morphed Gaussians.
  Buffer<float> frames;            // [B, U, kFrameFloats]
  Buffer<BlendScratch> blending;   // [threads]
  Buffer<float> blending_columns;  // [threads, ...]: what the scratch memory points to
  Buffer<float> weight_gradient;   // [chunks, B, K]
  Buffer<float> carried;           // [B, N, kCarriedFloats]
  Buffer<float> frame_gradient;    // [threads, U, kFrameFloats]
  Buffer<double> loss;             // [B, tiles]
  Buffer<Sighting> sightings;      // those of the last forward_loss that asked for them
  Buffer<float> largest;           // [N]: their largest weight
};

struct Cameras {
  const float *world_to_camera, *focal_px, *principal_point_px;
  int count;
};

// Names of the instruction sets this processor runs, the fastest first.
std::vector<std::string> instruction_sets();

// The loops of one of them; an empty name means the fastest. Throws std::invalid_argument.
const Kernels* kernels_for(const std::string& name);

// Projects and sorts at construction; then draws, averages and differentiates any number of
// times. The Gaussians' memory is not kept: the caller passes the same scene again.
class Rendering {
 public:
  Rendering(const Scene& scene, const Cameras& cameras, const std::string& instruction_set,
            int threads);
  ~Rendering();
  Rendering(const Rendering&) = delete;
  Rendering& operator=(const Rendering&) = delete;

  // image [S, H, W, 3], alpha [S, H, W], depth [S, H, W] or null, of the S sets from `first` on;
  // background [B or 1, 3].
  void draw(const Attribute& background, int first, int sets, float* image, float* alpha,
            float* depth, int threads);

  // images [B or 1, H, W, C] with C >= 0; outputs [B, N, C], [B, N], [B, N]; each may be null.
  void average(const Attribute& images, int channels, float* weighted_sum, float* weight_sum,
               float* max_weight, int threads);

  // Fills `gradient`, whose arrays have the shapes of the scene's attributes.
  void backward(const Scene& scene, const Attribute& background, const float* image_grad,
                const float* alpha_grad, const SceneGradient& gradient, int threads);

 protected:
  Rendering(int batch, int count, int width, int height, const Cameras& cameras,
            const std::string& instruction_set);
  void sort(class Team& team);
  void make_room_for_entries();
  // How many of a part's Gaussians touch each tile; once for each part of the image.
  void count_part(int image, int part);
  // What was counted goes into tiles, and each Gaussian's slots are laid out unless no sums follow.
  void put_into_tiles(class Team& team, bool with_slots);
  void sort_tile(int image, int tile, int thread);
  int parts_per_image() const;
  void lay_out_slots(int width);
  void make_scratch(int threads);
  Tile tile(int image, int index) const;
  int tiles_per_image() const { return tiles_x_ * tiles_y_; }

  // Gaussians that one thread puts into tiles at a time; a multiple of the SIMD lanes.
  static constexpr int kPart = 4096;

  int batch_, count_, width_, height_, tiles_x_, tiles_y_;
  const Kernels* kernels_;
  std::unique_ptr<Workspace> workspace_;

 private:
  uint32_t* part_start(int image, int part);
  void lay_out_entries(int image);
  template <bool kWithSlots>
  void fill_part(int image, int part);
};

// A Rendering of morphed Gaussians, which can train them. The scene's memory is not kept.
class MorphedRendering : public Rendering {
 public:
  MorphedRendering(MorphedScene scene, const Cameras& cameras, const std::string& instruction_set,
                   int threads);

  // The mean absolute difference to images [B, H, W, 4] of 8 bits over backgrounds [B or 1, 3];
  // keeps what `backward_adam` needs. With `sight`, adds what the waiting Gaussians are seen with of
  // which some pixel shows enough: these are `shown` then, each once.
  double forward_loss(const uint8_t* images, const Attribute& background, const FirstSight* sight,
                      int threads);

  const std::vector<int64_t>& shown() const { return shown_; }

  // One step of Adam by the gradient of the last forward_loss, or none without an optimizer; writes
  // the gradients of the weights, [B, K], and, unless it is null, of the vertices, [B, V, 3].
  void backward_adam(MorphedScene scene, const MorphedOptimizer* optimizer, float* weight_gradient,
              float* vertex_gradient, int threads);

 private:
  void lay_out_blending(const MorphedScene& scene, const class Team& team);
  template <class TargetOf>
  void add_sightings(const FirstSight& sight, Sightings found, const TargetOf& target_of,
                     class Team& team);

  std::vector<int64_t> shown_;
};

}  // namespace rgbavatar
