// Every kernel of the CUDA backend, for NVRTC: one translation unit, no header but our own.
#if defined(__CUDACC_RTC__)
typedef unsigned char uint8_t;
typedef int int32_t;
typedef unsigned int uint32_t;
typedef long long int64_t;
typedef unsigned long long uint64_t;

// One launch: `a` holds its arguments, after these the threads of a block and, where the compiler
// would take more registers than they allow, the blocks of an SM. Shared memory is that of a block.
#define RGBAVATAR_KERNEL(name, Arguments, ...) \
  extern "C" __global__ void __launch_bounds__(__VA_ARGS__) name##_kernel(const Arguments a)
#define RGBAVATAR_SHARED __shared__
#define RGBAVATAR_DYNAMIC_SHARED(Type, name) extern __shared__ Type name[]
#endif  // the tests define these for a processor

#include "arguments.h"
#include "device.cuh"
#include "project.cuh"
#include "bins.cuh"
#include "blend_tile.cuh"
#include "tile_sums.cuh"
#include "gradient.cuh"
#include "update.cuh"
