// Passes that sum over pixels for each Gaussian of a tile: gradients and weighted averages.
//
// Each warp sums its own pixels; the block then adds its eight warps in their order and writes the
// (Gaussian, tile) slot, which the gradient kernels add in the order of the tiles. No floating-point
// atomics: two runs give the same bits.

constexpr int kWarps = kTileThreads / 32;

template <int kSums>
struct WarpSums {
  SumBatch batch;
  float sums[kWarps][kBatch][kSums];
  alignas(8) uint8_t visited[kBatch][kWarps];  // 1 where a warp has summed a Gaussian of the batch
};

template <int kSums>
RGBAVATAR_FUNCTION void mark_visited(WarpSums<kSums>& shared, int group, unsigned visited) {
  const int lane = int(threadIdx.x) & 31, warp = int(threadIdx.x) >> 5;
  shared.visited[group + lane][warp] = uint8_t(visited >> lane & 1u);
}

// Adds up the warps' sums of a batch and writes its slots; `join(sum, other, which)` joins two. The
// next batch's sums may be written after another barrier.
template <int kSums, class Join>
RGBAVATAR_FUNCTION void write_slots(WarpSums<kSums>& shared, int page, int number, int width,
                                    float* slots, const Join& join) {
  __syncthreads();
  for (int i = int(threadIdx.x); i < number * width; i += kTileThreads) {
    const int place = i / width, which = i % width;
    const uint64_t by = *reinterpret_cast<const uint64_t*>(shared.visited[place]);
    float sum = 0.0f;
#pragma unroll
    for (int warp = 0; warp < kWarps; ++warp)
      if (by >> 8 * warp & 1u) sum = join(sum, shared.sums[warp][place][which], which);
    slots[int64_t(shared.batch.slots[page][place]) * width + which] = sum;
  }
}

// Zeros for the Gaussians that no pixel was open for any more.
RGBAVATAR_FUNCTION void clear_rest(const TileList& list, int first, int width, float* slots) {
  for (int entry = first + int(threadIdx.x); entry < list.count; entry += kTileThreads) {
    const uint32_t gaussian = list.gaussian_of(entry);
    const uint32_t slot = list.slot_of(list.splats[gaussian], list.slot_start[gaussian]);
    for (int k = 0; k < width; ++k) slots[int64_t(slot) * width + k] = 0.0f;
  }
}

// What a pixel shows to those that wait for their first colour: its share, and the colour times it.
struct SeenPixel {
  Vec3<float> color = {0.0f, 0.0f, 0.0f};
  float share = 0.0f;
  int64_t* sums = nullptr;  // null where the image does not count

  // Adds what a warp sees of a Gaussian, whose weight in the pixel is w; all its lanes together.
  RGBAVATAR_FUNCTION void add(uint32_t waiting, float w) const {
    const float largest = warp_max(w);
    const float all[kSightSums] = {warp_sum(w * color.x), warp_sum(w * color.y),
                                   warp_sum(w * color.z), warp_sum(w * share), largest};
    if ((threadIdx.x & 31) || !(largest > 0.0f)) return;
    unsigned long long* to =
        reinterpret_cast<unsigned long long*>(sums) + int64_t(waiting - 1u) * kSightSums;
    for (int k = 0; k + 1 < kSightSums; ++k) atomicAdd(to + k, in_sight_units(all[k]));
    atomicMax(to + kSightSums - 1, in_sight_units(largest));
  }
};

// The backward pass of the blending (gaussian_math.h) from g = dL/dimage and the remainder S. Some
// Gaussians may wait for their first colour where kSight is true.
template <bool kSight>
RGBAVATAR_FUNCTION void differentiate_tile(const TileList& list, const Pixel& pixel, Batch& batch,
                                           WarpSums<kMoments>& shared, KeptGroups* kept, int known,
                                           const Vec3<float>& g, float remainder, float* slots,
                                           const SeenPixel& seen) {
  // Of nine sums lane 4k writes the kth, lane 1 the last.
  const int lane = int(threadIdx.x) & 31;
  const bool writes_last = lane == 1, writes = (lane & 3) == 0 || writes_last;
  float* to = &shared.sums[threadIdx.x >> 5][0][writes_last ? kMoments - 1 : lane >> 2];
  float transmittance = pixel.inside ? 1.0f : 0.0f;
  const int read = walk(
      Reader(list, batch, &shared.batch), pixel, transmittance, kept, known,
      [&](int page, int place, const Splat& s, const Touch& touch) {
        const float w = weight_of(touch, transmittance);
        if (kSight && shared.batch.waiting[page][place])
          seen.add(shared.batch.waiting[page][place], w);
        const float along = w * (g.x * s.red + g.y * s.green + g.z * s.blue);
        remainder -= along;
        transmittance -= w;
        // alpha dL/dalpha; the cap has no gradient.
        const float share = touch.alpha * reciprocal_of(1.0f - touch.alpha);
        const float d = touch.capped ? 0.0f : C::kLn2 * (along - remainder * share);
        const float d_x = d * touch.dx, d_y = d * touch.dy;
        const float moments[8] = {w * g.x, w * g.y, w * g.z,      d,
                                  d_x,     d_y,     d_x * touch.dx, d_x * touch.dy};
        const float sum = warp_sums_of_eight(moments), last = warp_sum(d_y * touch.dy);
        if (writes) to[place * kMoments] = writes_last ? last : sum;
      },
      [&](int group, unsigned visited) { mark_visited(shared, group, visited); },
      [&](int page, int number) {
        write_slots(shared, page, number, kMoments, slots,
                    [](float sum, float other, int) { return sum + other; });
      });
  clear_rest(list, read, kMoments, slots);
}

// From the gradients of image and alpha.
RGBAVATAR_KERNEL(differentiate, DifferentiateArguments, kTileThreads) {
  RGBAVATAR_SHARED Batch batch;
  RGBAVATAR_SHARED WarpSums<kMoments> shared;
  const TileList list(a.frame, a.bins);
  const Pixel pixel(a.frame, list.tile_x, list.tile_y);
  const int64_t at = int64_t(blockIdx.y) * a.frame.width * a.frame.height + pixel.index;
  Vec3<float> g = {0.0f, 0.0f, 0.0f};
  float remainder = 0.0f;
  if (pixel.inside && a.image_gradient) {
    g = vec3_at(a.image_gradient, at);
    remainder = dot(g, vec3_at(a.image, at));
  }
  if (pixel.inside && a.alpha_gradient) remainder -= a.alpha_gradient[at] * (1.0f - a.alpha[at]);
  differentiate_tile<false>(list, pixel, batch, shared, nullptr, 0, g, remainder, a.slots, {});
}

// Forward pass, mean absolute difference to 8-bit images over a background, and backward pass in
// one go: no image is written. Pixels that nobody filmed add nothing.
RGBAVATAR_KERNEL(train, TrainArguments, kTileThreads, kTrainBlocks) {
  RGBAVATAR_SHARED Batch batch;
  RGBAVATAR_SHARED WarpSums<kMoments> shared;
  RGBAVATAR_SHARED KeptGroups kept;
  RGBAVATAR_SHARED float loss[kWarps];
  const TileList list(a.frame, a.bins, a.known);
  const Pixel pixel(a.frame, list.tile_x, list.tile_y);
  Blend blend(pixel);
  int known = 0;
  blend.run(list, pixel, batch, &kept, known);
  Vec3<float> g = {0.0f, 0.0f, 0.0f};
  float remainder = 0.0f, difference = 0.0f;
  SeenPixel seen;
  const int image = int(blockIdx.y);
  const int64_t which = a.image_of ? a.image_of[image] : image;
  if (a.known && which < a.sight_images) seen.sums = a.sight;
  if (pixel.inside) {
    const int64_t at = which * a.frame.width * a.frame.height + pixel.index;
    const uint32_t rgba = reinterpret_cast<const uint32_t*>(a.images)[at];
    const bool filmed = rgba != uint32_t(C::kUnfilmed);
    const float matte = float(rgba >> 24) * (1.0f / 255.0f);
    const Vec3<float> behind = background_of(a.background, a.background_shared);
    seen.share = !filmed ? 0.0f : a.over_background ? 1.0f : matte;
    const auto channel = [&](float color, float back, int shift, float& shown) {
      const float drawn = color + blend.transmittance * back;
      const float target = float(rgba >> shift & 255u) * (1.0f / 255.0f);
      const float over = back + matte * (target - back);
      const float off = filmed ? drawn - over : 0.0f;
      shown = seen.share * (a.over_background ? over : target);
      const float gradient = off > 0.0f ? a.gradient : off < 0.0f ? -a.gradient : 0.0f;
      difference += fabsf(off);
      remainder += gradient * drawn;
      return gradient;
    };
    g.x = channel(blend.red, behind.x, 0, seen.color.x);
    g.y = channel(blend.green, behind.y, 8, seen.color.y);
    g.z = channel(blend.blue, behind.z, 16, seen.color.z);
  }
  const float sum = warp_sum(difference);
  if ((threadIdx.x & 31) == 0) loss[threadIdx.x >> 5] = sum;
  __syncthreads();
  if (threadIdx.x == 0) {
    float all = 0.0f;
    for (int warp = 0; warp < kWarps; ++warp) all += loss[warp];
    a.loss[int64_t(blockIdx.y) * gridDim.x + blockIdx.x] = all;
  }
  if (seen.sums)
    differentiate_tile<true>(list, pixel, batch, shared, &kept, known, g, remainder, a.slots, seen);
  else
    differentiate_tile<false>(list, pixel, batch, shared, &kept, known, g, remainder, a.slots, {});
}

// Sums of w I (C channels) and w, and the largest w.
constexpr int kMaxSums = 10;
RGBAVATAR_KERNEL(average, AverageArguments, kTileThreads) {
  RGBAVATAR_SHARED Batch batch;
  RGBAVATAR_SHARED WarpSums<kMaxSums> shared;
  const TileList list(a.frame, a.bins);
  const Pixel pixel(a.frame, list.tile_x, list.tile_y);
  const int lane = int(threadIdx.x) & 31, warp = int(threadIdx.x) >> 5;
  const int64_t image = a.images_shared ? 0 : int64_t(blockIdx.y);
  const float* values =
      a.images + (image * a.frame.width * a.frame.height + pixel.index) * a.channels;
  float transmittance = pixel.inside ? 1.0f : 0.0f;
  int known = 0;
  const int read = walk(
      Reader(list, batch, &shared.batch), pixel, transmittance, nullptr, known,
      [&](int, int place, const Splat&, const Touch& touch) {
        const float w = weight_of(touch, transmittance);
        transmittance -= w;
        for (int k = 0; k < a.channels; ++k) {
          const float sum = warp_sum(w > 0.0f ? w * values[k] : 0.0f);
          if (lane == 0) shared.sums[warp][place][k] = sum;
        }
        const float sum = warp_sum(w), largest = warp_max(w);
        if (lane == 0) {
          shared.sums[warp][place][a.channels] = sum;
          shared.sums[warp][place][a.channels + 1] = largest;
        }
      },
      [&](int group, unsigned visited) { mark_visited(shared, group, visited); },
      [&](int page, int number) {
        write_slots(shared, page, number, a.channels + 2, a.slots,
                    [&](float sum, float other, int which) {
                      return which > a.channels ? fmaxf(sum, other) : sum + other;
                    });
      });
  clear_rest(list, read, a.channels + 2, a.slots);
}
