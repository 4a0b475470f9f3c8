// Threads that wait for work, kept from call to call: starting one costs as much as a small call.
#pragma once

#if !defined(_WIN32)
#include <pthread.h>
#endif

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <memory>
#include <mutex>
#include <system_error>
#include <thread>
#include <vector>

namespace rgbavatar {

// What a crew works at: items that each thread takes until there are none.
struct CrewJob {
  virtual void work(int thread) const = 0;
  virtual ~CrewJob() = default;
};

class Crew {
 public:
  // As many threads, or fewer where the system gives no more; they end with the crew.
  explicit Crew(int threads) {
    try {
      for (int i = 1; i <= threads; ++i) threads_.emplace_back([this, i] { serve(i); });
    } catch (const std::system_error&) {
    }
  }
  ~Crew() {
    begin(nullptr);
    for (std::thread& thread : threads_) thread.join();
  }
  Crew(const Crew&) = delete;
  Crew& operator=(const Crew&) = delete;

  int size() const { return int(threads_.size()); }

  // The caller is thread 0; returns when all have done.
  void run(const CrewJob& job) {
    begin(&job);
    job.work(0);
    wait(finished_, [this] { return busy_.load(std::memory_order_acquire) == 0; });
  }

 private:
  // A moment of looking, since the next stage of a call follows at once; then sleep.
  template <class Condition>
  void wait(std::condition_variable& signal, const Condition& condition) {
    constexpr int kLooks = 1500;
    for (int look = 0; look < kLooks; ++look) {
      if (condition()) return;
#if defined(__x86_64__)
      __builtin_ia32_pause();
#elif defined(__aarch64__)
      __asm__ volatile("yield");
#endif
    }
    std::unique_lock<std::mutex> lock(mutex_);
    signal.wait(lock, condition);
  }

  void begin(const CrewJob* job) {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      job_ = job;
      busy_.store(size(), std::memory_order_relaxed);
      generation_.fetch_add(1, std::memory_order_release);
    }
    wake_.notify_all();
  }

  void serve(int thread) {
    for (uint64_t seen = 0;; ++seen) {
      wait(wake_, [&] { return generation_.load(std::memory_order_acquire) != seen; });
      if (!job_) return;
      job_->work(thread);
      if (busy_.fetch_sub(1, std::memory_order_acq_rel) == 1) {
        std::lock_guard<std::mutex> lock(mutex_);
        finished_.notify_one();
      }
    }
  }

  std::mutex mutex_;
  std::condition_variable wake_, finished_;
  const CrewJob* job_ = nullptr;
  std::atomic<uint64_t> generation_{0};
  std::atomic<int> busy_{0};
  std::vector<std::thread> threads_;
};

// Crews that no call has. A forked process has none of its parent's threads, and begins anew; what
// waits at the end of the process ends with it.
class IdleCrews {
 public:
  static std::unique_ptr<Crew> take(int threads) {
    Idle& idle = here();
    {
      std::lock_guard<std::mutex> lock(idle.mutex);
      for (auto& crew : idle.crews)
        if (crew->size() == threads) {
          std::swap(crew, idle.crews.back());
          std::unique_ptr<Crew> taken = std::move(idle.crews.back());
          idle.crews.pop_back();
          return taken;
        }
    }
    return std::make_unique<Crew>(threads);
  }

  static void give(std::unique_ptr<Crew> crew) {
    Idle& idle = here();
    std::unique_ptr<Crew> oldest;  // ends outside of the lock
    std::lock_guard<std::mutex> lock(idle.mutex);
    idle.crews.push_back(std::move(crew));
    if (idle.crews.size() <= kKept) return;
    oldest = std::move(idle.crews.front());
    idle.crews.erase(idle.crews.begin());
  }

 private:
  static constexpr size_t kKept = 2;
  struct Idle {
    std::mutex mutex;
    std::vector<std::unique_ptr<Crew>> crews;
  };

  static std::atomic<Idle*>& current() {
    static std::atomic<Idle*> idle{nullptr};
    return idle;
  }

  static Idle& here() {
#if !defined(_WIN32)
    static const int watching =
        pthread_atfork(nullptr, nullptr, [] { current().store(new Idle); });
    (void)watching;
#endif
    static Idle* const first = [] {
      current().store(new Idle);
      return current().load();
    }();
    (void)first;
    return *current().load();
  }
};

}  // namespace rgbavatar
