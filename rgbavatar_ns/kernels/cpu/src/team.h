// A few threads for the length of one call: nothing outlives it, so forks and shutdown are safe.
#pragma once

#include <atomic>
#include <condition_variable>
#include <mutex>
#include <thread>
#include <vector>

namespace rgbavatar {

class Team {
 public:
  explicit Team(int size) : size_(size < 1 ? 1 : size) {
    try {
      for (int i = 1; i < size_; ++i) threads_.emplace_back([this, i] { serve(i); });
    } catch (const std::system_error&) {
      size_ = int(threads_.size()) + 1;  // the system gives no more threads: work with fewer
    }
  }

  ~Team() {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      job_ = nullptr;
      ++generation_;
    }
    wake_.notify_all();
    for (std::thread& thread : threads_) thread.join();
  }

  Team(const Team&) = delete;
  Team& operator=(const Team&) = delete;

  int size() const { return size_; }

  // Calls work(item, thread) for every item below `count`, in no certain order, and waits. Each
  // thread takes the next item when it has finished one. `work` must not throw.
  template <class Work>
  void run(int64_t count, const Work& work) {
    next_ = 0;
    count_ = count;
    const Job<Work> job(work);
    {
      std::lock_guard<std::mutex> lock(mutex_);
      job_ = &job;
      busy_ = int(threads_.size());
      ++generation_;
    }
    if (!threads_.empty()) wake_.notify_all();
    take_items(job, 0);
    std::unique_lock<std::mutex> lock(mutex_);
    finished_.wait(lock, [this] { return busy_ == 0; });
  }

 private:
  struct AnyJob {
    virtual void operator()(int64_t item, int thread) const = 0;
    virtual ~AnyJob() = default;
  };

  template <class Work>
  struct Job final : AnyJob {
    const Work& work;
    explicit Job(const Work& w) : work(w) {}
    void operator()(int64_t item, int thread) const override { work(item, thread); }
  };

  void take_items(const AnyJob& job, int thread) {
    for (int64_t item; (item = next_.fetch_add(1)) < count_;) job(item, thread);
  }

  void serve(int thread) {
    int64_t seen = 0;
    for (;;) {
      const AnyJob* job;
      {
        std::unique_lock<std::mutex> lock(mutex_);
        wake_.wait(lock, [&] { return generation_ != seen; });
        seen = generation_;
        job = job_;
      }
      if (!job) return;
      take_items(*job, thread);
      std::lock_guard<std::mutex> lock(mutex_);
      if (--busy_ == 0) finished_.notify_one();
    }
  }

  int size_;
  std::vector<std::thread> threads_;
  std::mutex mutex_;
  std::condition_variable wake_, finished_;
  const AnyJob* job_ = nullptr;
  int64_t generation_ = 0, count_ = 0;
  int busy_ = 0;
  std::atomic<int64_t> next_{0};
};

}  // namespace rgbavatar
