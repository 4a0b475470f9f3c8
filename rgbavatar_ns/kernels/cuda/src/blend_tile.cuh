// Blending of one tile by one block: a thread a pixel, a warp eight by four of them.

// The pixel of a thread. A half of a warp is one of the 4 x 4 blocks that end together.
struct Pixel {
  int x, y;
  int64_t index;        // in its image
  float centre_x, centre_y;
  unsigned half;        // the lanes of its 4 x 4 block
  bool inside;          // of the image
  float left, top, right, bottom;  // the warp's pixel centres, within the image

  RGBAVATAR_FUNCTION Pixel(const Frame& frame, int tile_x, int tile_y) {
    const int lane = int(threadIdx.x) & 31, warp = int(threadIdx.x) >> 5;
    const int warp_x = tile_x * kTileSide + (warp & 1) * 8, warp_y = tile_y * kTileSide + warp / 2 * 4;
    x = warp_x + (lane >> 4) * 4 + (lane & 3);
    y = warp_y + ((lane & 15) >> 2);
    index = int64_t(y) * frame.width + x;
    centre_x = float(x) + 0.5f, centre_y = float(y) + 0.5f;
    half = lane < 16 ? 0x0000ffffu : 0xffff0000u;
    inside = x < frame.width && y < frame.height;
    left = float(warp_x) + 0.5f, top = float(warp_y) + 0.5f;
    right = fminf(left + 7.0f, float(frame.width) - 0.5f);
    bottom = fminf(top + 3.0f, float(frame.height) - 0.5f);
  }
};

// A tile's list, and some of its Gaussians at a time in shared memory.
constexpr int kBatch = 64;
struct Batch {
  Splat splats[kBatch];
  uint32_t slots[kBatch];
  uint32_t waiting[kBatch];  // a Gaussian's number and one, where it waits for its first colour
};

struct TileList {
  const Splat* splats;
  const uint32_t* slot_start;
  const uint64_t* entries;
  const uint8_t* known;
  int count, tile_x, tile_y;

  RGBAVATAR_FUNCTION TileList(const Frame& frame, const Bins& bins,
                              const uint8_t* known_colors = nullptr)
      : known(known_colors) {
    const int image = int(blockIdx.y);
    const int64_t tile = int64_t(image) * gridDim.x + blockIdx.x;
    tile_x = int(blockIdx.x) % frame.tiles_x, tile_y = int(blockIdx.x) / frame.tiles_x;
    splats = splats_of(frame, bins, image);
    slot_start = bins.slot_start + int64_t(image) * frame.count;
    const uint32_t start = bins.tile_start[tile];
    entries = bins.entries + start;
    count = overflowed(bins) ? 0 : int(bins.tile_start[tile + 1] - start);
  }

  // The entry's Gaussian and where its sums over this tile go.
  RGBAVATAR_FUNCTION Splat read(int entry, uint32_t& slot) const {
    const uint32_t gaussian = uint32_t(entries[entry]);
    const Splat s = splats[gaussian];
    slot = slot_start[gaussian] +
           uint32_t((tile_y - s.first_y()) * s.tiles_across() + tile_x - s.first_x());
    return s;
  }

  RGBAVATAR_FUNCTION uint32_t waiting(int entry) const {
    const uint32_t gaussian = uint32_t(entries[entry]);
    return known && !known[gaussian] ? gaussian + 1u : 0u;
  }
};

RGBAVATAR_FUNCTION bool is_open(float transmittance) {
  return transmittance >= C::kMinTransmittance;
}

// What a Gaussian does to a pixel: dx, dy from its mean, alpha after cut and cap (0 where its block
// of pixels is closed), and whether the cap was reached.
struct Touch {
  float dx, dy, alpha;
  bool capped;

  RGBAVATAR_FUNCTION Touch(const Splat& s, const Pixel& pixel, bool taken) {
    dx = pixel.centre_x - s.mean_x, dy = pixel.centre_y - s.mean_y;
    const float p = log2_alpha(dx, dy, s.log2_opacity, s.qa, s.qb, s.qc);
    const float raw = taken && p >= C::kLog2MinAlpha ? power_of_two(p) : 0.0f;
    alpha = fminf(raw, C::kMaxAlpha);
    capped = raw >= C::kMaxAlpha;
  }
};

// Calls visit(place, splat, touch) front to back with the Gaussians that may reach the warp's
// pixels, while one of these is open; the visitor changes the transmittance. All lanes of a warp
// make every call together. After each batch, end(first entry, number) is called by all threads of
// the block; the return value is the first entry that was not read.
template <class Visit, class End>
RGBAVATAR_FUNCTION int walk(const TileList& list, const Pixel& pixel, Batch& batch,
                            float& transmittance, const Visit& visit, const End& end) {
  const int lane = int(threadIdx.x) & 31;
  int first = 0;
  for (; first < list.count; first += kBatch) {
    if (!__syncthreads_or(is_open(transmittance))) break;
    const int number = list.count - first < kBatch ? list.count - first : kBatch;
    const int mine = int(threadIdx.x);
    if (mine < number) {
      batch.splats[mine] = list.read(first + mine, batch.slots[mine]);
      batch.waiting[mine] = list.waiting(first + mine);
    }
    __syncthreads();
    for (int group = 0; group < number; group += 32) {
      const bool near = group + lane < number &&
                        touches(batch.splats[group + lane], pixel.left, pixel.top, pixel.right,
                                pixel.bottom);
      for (unsigned left = __ballot_sync(kWholeWarp, near); left; left &= left - 1) {
        const unsigned open = __ballot_sync(kWholeWarp, is_open(transmittance));
        if (!open) break;
        const int place = group + __ffs(int(left)) - 1;
        const Splat& s = batch.splats[place];
        visit(place, s, Touch(s, pixel, (open & pixel.half) != 0));
      }
    }
    end(first, number);
  }
  return first;
}

// Colour, depth and transmittance of a pixel. Pixels outside the image have a transmittance of 0:
// they take no part and keep no block open.
struct Blend {
  float red = 0.0f, green = 0.0f, blue = 0.0f, depth = 0.0f, transmittance;

  RGBAVATAR_FUNCTION explicit Blend(const Pixel& pixel)
      : transmittance(pixel.inside ? 1.0f : 0.0f) {}
  RGBAVATAR_FUNCTION void run(const TileList& list, const Pixel& pixel, Batch& batch) {
    walk(
        list, pixel, batch, transmittance,
        [&](int, const Splat& s, const Touch& touch) {
          const float w = touch.alpha * transmittance;
          red += w * s.red, green += w * s.green, blue += w * s.blue, depth += w * s.depth;
          transmittance -= w;
        },
        [](int, int) {});
  }
};

RGBAVATAR_FUNCTION Vec3<float> background_of(const float* background, int shared) {
  return vec3_at(background, shared ? 0 : int64_t(blockIdx.y));
}

RGBAVATAR_KERNEL(draw, DrawArguments, kTileThreads) {
  RGBAVATAR_SHARED Batch batch;
  const TileList list(a.frame, a.bins);
  const Pixel pixel(a.frame, list.tile_x, list.tile_y);
  Blend blend(pixel);
  blend.run(list, pixel, batch);
  if (!pixel.inside) return;
  const Vec3<float> behind = background_of(a.background, a.background_shared);
  const float t = blend.transmittance, alpha = 1.0f - t;
  const int64_t at = int64_t(blockIdx.y) * a.frame.width * a.frame.height + pixel.index;
  put_vec3({blend.red + t * behind.x, blend.green + t * behind.y, blend.blue + t * behind.z},
           a.image, at);
  a.alpha[at] = alpha;
  if (a.depth) a.depth[at] = alpha > 0.0f ? blend.depth / alpha : 0.0f;
}
