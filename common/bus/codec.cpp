#include "common/bus/codec.h"

#include <stdexcept>
#include <utility>

#include "common/bus/check.h"

namespace bodyschema {

template <class Message>
Decoded<Message> decode(const void* data, std::size_t size) {
  Decoded<Message> result;
  Message message{};
  if (size > kLargestOf<Message> ||
      message.decode(data, 0, static_cast<int>(size)) != static_cast<int>(size)) {
    result.problem = describe_malformed(data, size, Message::getTypeName(), Message::getHash());
    result.is_malformed = true;
    return result;
  }
  result.problem = check(message);
  if (result.problem.empty()) result.message = std::move(message);
  return result;
}

template <class Message>
std::vector<std::uint8_t> encode(const Channel<Message>& channel, const Message& message) {
  const std::string problem = check(message);
  if (!problem.empty()) {
    throw std::logic_error(std::string(channel.name) + " must not be sent: " + problem);
  }
  std::vector<std::uint8_t> bytes(static_cast<std::size_t>(message.getEncodedSize()));
  if (bytes.size() > kLargestOf<Message>) {
    throw std::runtime_error(std::string(channel.name) + " of " + std::to_string(bytes.size()) +
                             " bytes: at most " + std::to_string(kLargestOf<Message>) + " travel");
  }
  const int size = static_cast<int>(bytes.size());
  if (message.encode(bytes.data(), 0, size) != size) {
    throw std::logic_error(std::string(channel.name) + " could not be encoded");
  }
  return bytes;
}

// Instantiated here only, not in each source that sends or receives: lcm-gen's code compiles
// slowly.
#define BODYSCHEMA_CODEC(Message)                                      \
  template Decoded<Message> decode<Message>(const void*, std::size_t); \
  template std::vector<std::uint8_t> encode<Message>(const Channel<Message>&, const Message&);

BODYSCHEMA_CODEC(action_command_t)
BODYSCHEMA_CODEC(motion_status_t)
BODYSCHEMA_CODEC(sim_state_t)
BODYSCHEMA_CODEC(camera_image_t)
BODYSCHEMA_CODEC(camera_info_t)
BODYSCHEMA_CODEC(marker_poses_t)
BODYSCHEMA_CODEC(sample_t)
BODYSCHEMA_CODEC(sample_request_t)
BODYSCHEMA_CODEC(body_schema_t)
BODYSCHEMA_CODEC(model_health_t)
BODYSCHEMA_CODEC(pose_target_t)
BODYSCHEMA_CODEC(control_status_t)
BODYSCHEMA_CODEC(fault_command_t)
BODYSCHEMA_CODEC(process_info_t)

#undef BODYSCHEMA_CODEC

}  // namespace bodyschema
