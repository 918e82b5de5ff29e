#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <set>
#include <string>
#include <tuple>
#include <vector>

#include "common/bus/channels.h"

namespace bodyschema {

/// How a group is: what `status` shows.
struct GroupStatus {
  struct Process {
    process_info_t info;  ///< the newest
    double age_s = 0;
    double cpu_percent = 0;                 ///< share of one core
    std::vector<counter_t> other_counters;  ///< neither traffic nor in ChannelUse::dropped
  };
  struct ChannelUse {
    std::string name;
    std::int64_t count = 0;
    double rate_hz = 0;
    std::optional<double> age_s;                  ///< of the newest message; none came
    std::map<std::string, std::int64_t> dropped;  ///< see StatusBoard::dropped()
  };

  std::string headline;
  std::vector<std::string> missing, twins, warnings;
  std::vector<Process> processes;    ///< by host and name
  std::vector<ChannelUse> channels;  ///< by name; of which anything came, be it garbage
  std::optional<motion_status_t> motion;
  std::optional<control_status_t> control;
  std::optional<sample_t> sample;
  std::optional<sim_state_t> sim_state;
  std::optional<body_schema_t> schema;  ///< a proposal while none is accepted
  bool is_accepted = false;
  std::optional<model_health_t> health;
};

/// Listens to a group and says how it is. State is repeated at 1 Hz, so two seconds show all of it.
class StatusBoard {
 public:
  /// Processes that a group should have; robot_simulator is not missed where another driver
  /// answers. `own_version`: of this program.
  StatusBoard(std::set<std::string> expected, std::string own_version);

  /// Times are this machine's clock [us].
  void begin(std::int64_t now_us);
  /// Any message of the channel arrived.
  void on_arrival(const std::string& channel, std::int64_t now_us);
  void on_message(const process_info_t& info);
  void on_message(const motion_status_t& status) { newest_.motion = status; }
  void on_message(const control_status_t& status) { newest_.control = status; }
  void on_message(const sample_t& sample) { newest_.sample = sample; }
  /// BODY_SCHEMA; a proposal counts while there is none.
  void on_body_schema(const body_schema_t& schema);
  void on_learned_schema(const body_schema_t& schema);
  void on_message(const model_health_t& health) { newest_.health = health; }
  void on_message(const sim_state_t& state) { newest_.sim_state = state; }
  /// Messages that this listener itself had to drop: Bus::counters().
  void on_own_counters(const std::map<std::string, std::int64_t>& counters);
  void end(std::int64_t now_us) { end_us_ = now_us; }

  /// True if nothing at all arrived, not even garbage.
  bool is_silent() const { return arrivals_.empty() && num_dropped_here() == 0; }
  /// One sentence: what the system is doing, what it waits for.
  std::string headline() const;
  GroupStatus status() const;

 private:
  struct Arrivals {
    std::int64_t count = 0;
    std::int64_t last_us = 0;
  };
  /// First and newest PROCESS_INFO of one process.
  struct Heard {
    process_info_t first;
    process_info_t newest;

    bool has_ended() const { return newest.phase == process_info_t::PHASE_ENDED; }
    double age_s() const;
    /// Share of one core while listening; since the start where it was heard but once.
    double cpu_percent() const;
  };
  using Key = std::tuple<std::string, std::string, std::int32_t>;  ///< host, name, pid

  /// The headline without who else waits.
  std::string activity() const;
  std::vector<std::string> missing() const;
  /// Names of which several processes are alive.
  std::vector<std::string> twins() const;
  /// Faults that need somebody's attention, for people.
  std::vector<std::string> warnings() const;
  const Heard* find(const std::string& name) const;
  /// Names of those on which anything came, be it garbage.
  std::set<std::string> channels() const;
  /// "malformed", "senseless", … of a channel: the most that any process counted, since its start.
  std::map<std::string, std::int64_t> dropped(const std::string& channel) const;
  std::int64_t num_dropped_here() const;

  const std::set<std::string> expected_;
  const std::string own_version_;
  std::int64_t begin_us_ = 0;
  std::int64_t end_us_ = 0;
  std::map<std::string, Arrivals> arrivals_;
  std::map<std::string, std::int64_t> own_counters_;
  std::map<Key, Heard> processes_;
  GroupStatus newest_;  ///< messages alone
};

}  // namespace bodyschema
