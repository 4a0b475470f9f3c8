// A few threads for the length of one call, which are the process's where they are free.
#pragma once

#include "crew.h"

namespace rgbavatar {

class Team {
 public:
  explicit Team(int size) {
    if (size > 1) crew_ = IdleCrews::take(size - 1);
  }
  ~Team() {
    if (crew_) IdleCrews::give(std::move(crew_));
  }
  Team(const Team&) = delete;
  Team& operator=(const Team&) = delete;

  int size() const { return crew_ ? crew_->size() + 1 : 1; }

  // Calls work(item, thread) for every item below `count`, in no certain order, and waits. Each
  // thread takes the next item when it has finished one. `work` must not throw.
  template <class Work>
  void run(int64_t count, const Work& work) {
    if (!crew_ || count <= 1) {
      for (int64_t item = 0; item < count; ++item) work(item, 0);
      return;
    }
    crew_->run(Items<Work>(count, work));
  }

 private:
  template <class Work>
  struct Items final : CrewJob {
    const int64_t count;
    const Work& each;
    mutable std::atomic<int64_t> next{0};

    Items(int64_t n, const Work& w) : count(n), each(w) {}
    void work(int thread) const override {
      for (int64_t item; (item = next.fetch_add(1)) < count;) each(item, thread);
    }
  };

  std::unique_ptr<Crew> crew_;
};

}  // namespace rgbavatar
