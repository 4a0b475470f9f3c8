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

// Some of a tile's Gaussians in shared memory: those that are blended, and the next, which are on
// their way meanwhile.
constexpr int kBatch = 64;
struct Batch {
  Splat splats[2][kBatch];
};

// What passes that sum over pixels also need of them.
struct SumBatch {
  uint32_t slots[2][kBatch];
  uint32_t waiting[2][kBatch];  // a Gaussian's number and one, where it waits for its first colour
};

// Which Gaussians of a list reach each warp's pixels, by groups of 32: found by one pass over the
// list for the next. Behind kKeptGroups they are found again.
constexpr int kKeptGroups = 32;
struct KeptGroups {
  uint32_t near[kTileThreads / 32][kKeptGroups];
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

  RGBAVATAR_FUNCTION uint32_t gaussian_of(int entry) const { return uint32_t(entries[entry]); }

  // Where the sums of a Gaussian over this tile go; `start` is its first slot.
  RGBAVATAR_FUNCTION uint32_t slot_of(const Splat& s, uint32_t start) const {
    return start + uint32_t((tile_y - s.first_y()) * s.tiles_across() + tile_x - s.first_x());
  }

  RGBAVATAR_FUNCTION uint32_t waiting(uint32_t gaussian) const {
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

// The weight of a touch in its pixel. Rounded as it stands, so that every pass over a list finds the
// same transmittances and ends at the same Gaussian.
RGBAVATAR_FUNCTION float weight_of(const Touch& touch, float transmittance) {
  return __fmul_rn(touch.alpha, transmittance);
}

// A pass over a tile's list, which a thread of a block begins by knowing its Gaussian of the first
// batch. All threads of the block have left the pass before.
struct Reader {
  const TileList& list;
  Batch& batch;
  SumBatch* sums;  // null where no slots are wanted
  uint32_t gaussian, after, start;  // of the batch on its way; of the one behind; its first slot

  RGBAVATAR_FUNCTION Reader(const TileList& of, Batch& into, SumBatch* with)
      : list(of), batch(into), sums(with), gaussian(0u), after(0u), start(0u) {
    if (has(0)) after = list.gaussian_of(int(threadIdx.x));
    begin(0);
  }
  RGBAVATAR_FUNCTION bool has(int first) const {
    return int(threadIdx.x) < kBatch && first + int(threadIdx.x) < list.count;
  }
  // Sends for the batch at `first`, and learns the numbers of the one behind it.
  RGBAVATAR_FUNCTION void begin(int first) {
    if (!has(first)) return;
    gaussian = after;
    begin_copy(batch.splats[first / kBatch & 1][threadIdx.x], list.splats[gaussian]);
    if (sums) start = list.slot_start[gaussian];
    if (has(first + kBatch)) after = list.gaussian_of(first + kBatch + int(threadIdx.x));
  }
  // The batch is there for others after a barrier.
  RGBAVATAR_FUNCTION void finish(int first) {
    finish_copies();
    if (!sums || !has(first)) return;
    const int page = first / kBatch & 1;
    sums->slots[page][threadIdx.x] = list.slot_of(batch.splats[page][threadIdx.x], start);
    if (list.known) sums->waiting[page][threadIdx.x] = list.waiting(gaussian);
  }
};

// Calls visit(page, place, splat, touch) front to back with the Gaussians that may reach the warp's
// pixels, while one of these is open; the visitor changes the transmittance. All lanes of a warp
// make every call together; after each group of 32, group_end(its first place, bits of the visited).
// After each batch, end(page, number) is called by all threads of the block. The return value is
// the first entry that was not read.
//
// `kept` may be null; `known` is how many groups of it an earlier pass has found for this warp, and
// becomes how many are found now.
template <class Visit, class GroupEnd, class End>
RGBAVATAR_FUNCTION int walk(Reader reader, const Pixel& pixel, float& transmittance,
                            KeptGroups* kept, int& known, const Visit& visit,
                            const GroupEnd& group_end, const End& end) {
  const int lane = int(threadIdx.x) & 31, warp = int(threadIdx.x) >> 5, total = reader.list.count;
  int first = 0;
  for (; first < total; first += kBatch) {
    reader.finish(first);
    if (!__syncthreads_or(is_open(transmittance))) break;
    reader.begin(first + kBatch);
    __syncthreads();  // the compiler knows by it that warps are whole: 31 instructions a visit, else 42
    const int page = first / kBatch & 1;
    const Splat* splats = reader.batch.splats[page];
    const int number = total - first < kBatch ? total - first : kBatch;
    for (int group = 0; group < number; group += 32) {
      const int which = (first + group) / 32;
      const bool found = kept && which < known;
      bool reaches = false;
      if (found) {
        reaches = kept->near[warp][which] >> lane & 1u;
      } else if (__ballot_sync(kWholeWarp, is_open(transmittance))) {
        reaches = group + lane < number && touches(splats[group + lane], pixel.left, pixel.top,
                                                   pixel.right, pixel.bottom);
      }
      const unsigned near = __ballot_sync(kWholeWarp, reaches);
      if (kept && !found && which == known && known < kKeptGroups) {
        if (lane == 0) kept->near[warp][which] = near;
        ++known;
      }
      unsigned left = near;
      for (; left; left &= left - 1) {
        const unsigned open = __ballot_sync(kWholeWarp, is_open(transmittance));
        if (!open) break;
        const int place = group + __ffs(int(left)) - 1;
        const Splat& s = splats[place];
        visit(page, place, s, Touch(s, pixel, (open & pixel.half) != 0));
      }
      group_end(group, near & ~left);
    }
    end(page, number);
  }
  return first;
}

// Colour, depth and transmittance of a pixel. Pixels outside the image have a transmittance of 0:
// they take no part and keep no block open.
struct Blend {
  float red = 0.0f, green = 0.0f, blue = 0.0f, depth = 0.0f, transmittance;

  RGBAVATAR_FUNCTION explicit Blend(const Pixel& pixel)
      : transmittance(pixel.inside ? 1.0f : 0.0f) {}
  RGBAVATAR_FUNCTION void run(const TileList& list, const Pixel& pixel, Batch& batch,
                              KeptGroups* kept, int& known) {
    walk(
        Reader(list, batch, nullptr), pixel, transmittance, kept, known,
        [&](int, int, const Splat& s, const Touch& touch) {
          const float w = weight_of(touch, transmittance);
          red += w * s.red, green += w * s.green, blue += w * s.blue, depth += w * s.depth;
          transmittance -= w;
        },
        [](int, unsigned) {}, [](int, int) {});
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
  int known = 0;
  blend.run(list, pixel, batch, nullptr, known);
  if (!pixel.inside) return;
  const Vec3<float> behind = background_of(a.background, a.background_shared);
  const float t = blend.transmittance, alpha = 1.0f - t;
  const int64_t at = int64_t(blockIdx.y) * a.frame.width * a.frame.height + pixel.index;
  put_vec3({blend.red + t * behind.x, blend.green + t * behind.y, blend.blue + t * behind.z},
           a.image, at);
  a.alpha[at] = alpha;
  if (a.depth) a.depth[at] = alpha > 0.0f ? blend.depth / alpha : 0.0f;
}
