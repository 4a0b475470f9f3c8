// The CUDA kernels on a processor: every thread of a block is a fiber, which runs until it has to
// wait for others. What is tested this way are the kernels' own lines, not a copy of them; races and
// speed are not. A collective that not all threads reach ends the process with its name.
#include <setjmp.h>
#include <ucontext.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <memory>
#include <numeric>
#include <random>
#include <vector>

struct Index {
  unsigned x = 0, y = 0;
};
static Index threadIdx, blockIdx, blockDim, gridDim;

namespace emulation {

constexpr size_t kStackBytes = 64 << 10;
constexpr int kWarp = 32;

// Where threads meet: what each brought, for this meeting and the next.
struct Meeting {
  uint64_t arrivals = 0;
  uint64_t brought[2][1024];
  const char* kind[2] = {};
};

struct Fiber {
  ucontext_t context;
  jmp_buf at;
  std::unique_ptr<char[]> stack{new char[kStackBytes]};
  bool started = false, done = false;
  uint64_t warp_meetings = 0, block_meetings = 0;
  const char* waits_for = nullptr;
  const Meeting* meeting = nullptr;
  uint64_t complete = 0;

  bool can_go_on() const { return !done && (!meeting || meeting->arrivals >= complete); }
};

static std::vector<Fiber> fibers(1024);
static Meeting block, warps[32];
static unsigned current, threads;
static jmp_buf scheduler;
static const std::function<void()>* body;
alignas(64) static char dynamic_shared[1 << 18];

[[noreturn]] static void fail(const char* what, const char* kind) {
  std::fprintf(stderr, "emulated kernel: %s (%s)\n", what, kind);
  std::abort();
}

static void yield() {
  if (!_setjmp(fibers[current].at)) _longjmp(scheduler, 1);
}

// A fiber is made once and serves block after block: making one asks the system twice.
static void enter() {
  for (;;) {
    (*body)();
    fibers[current].done = true;
    yield();
  }
}

// Brings a value to a meeting of `number` threads; returns what all brought, by thread.
static const uint64_t* meet(Meeting& meeting, uint64_t& mine, unsigned place, unsigned number,
                            uint64_t value, const char* kind) {
  const uint64_t which = mine++;
  const int page = int(which & 1);
  const uint64_t complete = (which + 1) * number;
  if (meeting.arrivals + number == complete) meeting.kind[page] = kind;
  const char* const first = meeting.kind[page];
  if (first != kind && std::strcmp(first, kind))
    fail("threads met at different collectives", kind);
  meeting.brought[page][place] = value;
  ++meeting.arrivals;
  Fiber& fiber = fibers[current];
  fiber.waits_for = kind;
  fiber.meeting = &meeting;
  fiber.complete = complete;
  if (!fiber.can_go_on()) yield();
  fiber.waits_for = nullptr;
  fiber.meeting = nullptr;
  return meeting.brought[page];
}

static const uint64_t* meet_warp(uint64_t value, const char* kind) {
  return meet(warps[current / kWarp], fibers[current].warp_meetings, current % kWarp, kWarp, value,
              kind);
}
static const uint64_t* meet_block(uint64_t value, const char* kind) {
  return meet(block, fibers[current].block_meetings, current, threads, value, kind);
}

static void run_block(std::mt19937& random) {
  block.arrivals = 0;
  for (Meeting& warp : warps) warp.arrivals = 0;
  for (unsigned i = 0; i < threads; ++i) {
    Fiber& fiber = fibers[i];
    fiber.done = false;
    fiber.warp_meetings = fiber.block_meetings = 0;
    fiber.waits_for = nullptr;
    fiber.meeting = nullptr;
  }
  std::vector<unsigned> order(threads);
  std::iota(order.begin(), order.end(), 0u);
  std::shuffle(order.begin(), order.end(), random);
  for (volatile unsigned left = threads; left;) {
    const uint64_t before = block.arrivals;
    uint64_t warp_before = 0, warp_after = 0;
    for (const Meeting& warp : warps) warp_before += warp.arrivals;
    const unsigned left_before = left;
    for (volatile unsigned i = 0; i < threads; i = i + 1) {
      current = order[i];
      Fiber& fiber = fibers[current];
      if (!fiber.can_go_on()) continue;
      threadIdx.x = current;
      if (!_setjmp(scheduler)) {
        if (fiber.started) _longjmp(fiber.at, 1);
        fiber.started = true;
        getcontext(&fiber.context);
        fiber.context.uc_stack.ss_sp = fiber.stack.get();
        fiber.context.uc_stack.ss_size = kStackBytes;
        fiber.context.uc_link = nullptr;
        makecontext(&fiber.context, enter, 0);
        setcontext(&fiber.context);
      }
      if (fibers[current].done) left = left - 1;
    }
    for (const Meeting& warp : warps) warp_after += warp.arrivals;
    if (left && left == left_before && before == block.arrivals && warp_before == warp_after)
      for (unsigned i = 0; i < threads; ++i)
        if (!fibers[i].done) fail("a collective that not all threads reach", fibers[i].waits_for);
  }
}

static void run_grid(unsigned grid_x, unsigned grid_y, unsigned block_threads, unsigned seed,
                     const std::function<void()>& kernel) {
  std::mt19937 random(seed);
  threads = block_threads;
  body = &kernel;
  gridDim.x = grid_x, gridDim.y = grid_y, blockDim.x = threads;
  for (blockIdx.y = 0; blockIdx.y < grid_y; ++blockIdx.y)
    for (blockIdx.x = 0; blockIdx.x < grid_x; ++blockIdx.x) {
      std::memset(dynamic_shared, 0xff, sizeof dynamic_shared);  // NaN until it is written
      run_block(random);
    }
}

template <class T>
static uint64_t bits_of(T value) {
  uint64_t bits = 0;
  std::memcpy(&bits, &value, sizeof value);
  return bits;
}
template <class T>
static T value_of(uint64_t bits) {
  T value;
  std::memcpy(&value, &bits, sizeof value);
  return value;
}

}  // namespace emulation

#define __device__
#define __forceinline__ inline

static void __syncthreads() { emulation::meet_block(0, "__syncthreads"); }
static void __syncwarp() { emulation::meet_warp(0, "__syncwarp"); }
static int __syncthreads_or(int value) {
  const uint64_t* all = emulation::meet_block(value != 0, "__syncthreads_or");
  return std::any_of(all, all + emulation::threads, [](uint64_t v) { return v != 0; });
}
static unsigned __ballot_sync(unsigned, bool value) {
  const uint64_t* all = emulation::meet_warp(value, "__ballot_sync");
  unsigned mask = 0;
  for (int i = 0; i < 32; ++i) mask |= unsigned(all[i]) << i;
  return mask;
}
template <class T>
static T __shfl_sync(unsigned, T value, int lane) {
  return emulation::value_of<T>(
      emulation::meet_warp(emulation::bits_of(value), "__shfl_sync")[lane & 31]);
}
template <class T>
static T __shfl_xor_sync(unsigned, T value, int mask) {
  const int lane = int(threadIdx.x & 31) ^ mask;
  return emulation::value_of<T>(
      emulation::meet_warp(emulation::bits_of(value), "__shfl_xor_sync")[lane]);
}
template <class T>
static T __shfl_up_sync(unsigned, T value, int distance) {
  const int lane = int(threadIdx.x & 31);
  const uint64_t* all = emulation::meet_warp(emulation::bits_of(value), "__shfl_up_sync");
  return emulation::value_of<T>(all[lane >= distance ? lane - distance : lane]);
}
static unsigned long long atomicAdd(unsigned long long* at, unsigned long long value) {
  const unsigned long long old = *at;
  *at += value;
  return old;
}
static unsigned long long atomicMax(unsigned long long* at, unsigned long long value) {
  const unsigned long long old = *at;
  *at = old > value ? old : value;
  return old;
}
static unsigned atomicAdd(unsigned* at, unsigned value) {
  const unsigned old = *at;
  *at += value;
  return old;
}
static unsigned atomicSub(unsigned* at, unsigned value) {
  const unsigned old = *at;
  *at -= value;
  return old;
}
static float __fmaf_rn(float a, float b, float c) { return std::fma(a, b, c); }
static float __fmul_rn(float a, float b) { return a * b; }
static float __fdividef(float a, float b) { return a / b; }
static int __ffs(int value) { return __builtin_ffs(value); }
static unsigned __float_as_uint(float value) {
  return unsigned(emulation::bits_of(value));
}

#define RGBAVATAR_KERNEL(name, Arguments, ...)                                                   \
  static void name##_body(const Arguments& a);                                                   \
  extern "C" void name##_emulated(const void* arguments, unsigned grid_x, unsigned grid_y,       \
                                  unsigned block_threads, unsigned seed) {                       \
    const Arguments& a = *static_cast<const Arguments*>(arguments);                              \
    emulation::run_grid(grid_x, grid_y, block_threads, seed, [&] { name##_body(a); });           \
  }                                                                                              \
  extern "C" unsigned name##_argument_bytes() { return sizeof(Arguments); }                      \
  static void name##_body(const Arguments& a)
#define RGBAVATAR_SHARED static
#define RGBAVATAR_DYNAMIC_SHARED(Type, name) \
  Type* const name = reinterpret_cast<Type*>(emulation::dynamic_shared)

#include "kernels.cu"
