#include "processes/console/report/template.h"

#include <map>
#include <stdexcept>
#include <vector>

namespace bodyschema {
namespace {

bool is_nothing(const Json& value) {
  return value.is_null() || value == false || value == "" || (value.is_array() && value.empty());
}

using Sections = std::vector<const Json*>;  ///< the innermost last

/// The text before `end`; `text` is then the rest after it.
std::string_view take_up_to(std::string_view& text, const std::string& end) {
  const std::size_t at = text.find(end);
  if (at == std::string_view::npos) throw std::logic_error("template: no " + end);
  const std::string_view head = text.substr(0, at);
  text.remove_prefix(at + end.size());
  return head;
}

Json find(const Sections& sections, const std::string& key) {
  if (key == ".") return *sections.back();
  for (auto section = sections.rbegin(); section != sections.rend(); ++section) {
    if ((*section)->contains(key)) return (*section)->at(key);
  }
  return nullptr;
}

std::string render(std::string_view text, const Sections& sections) {
  std::string result;
  const auto render_in = [&](std::string_view body, const Json& item) {
    Sections inner = sections;
    inner.push_back(&item);
    result += render(body, inner);
  };
  for (std::size_t tag; (tag = text.find("{{")) != std::string_view::npos;) {
    result += text.substr(0, tag);
    text.remove_prefix(tag + 2);
    const bool is_raw = text.starts_with('{');
    std::string key(take_up_to(text, is_raw ? "}}}" : "}}"));
    const char kind = key.empty() ? ' ' : key.front();
    if (kind == '{' || kind == '#' || kind == '^') key.erase(0, 1);
    const Json value = find(sections, key);
    if (kind == '#' || kind == '^') {
      const std::string_view body = take_up_to(text, "{{/" + key + "}}");
      if (is_nothing(value) != (kind == '^')) continue;
      if (kind == '^' || !value.is_array()) {
        render_in(body, value);
      } else {
        for (const Json& item : value) render_in(body, item);
      }
    } else if (!value.is_null()) {
      const std::string shown = value.is_string() ? value.get<std::string>() : value.dump();
      result += is_raw ? shown : escape_html(shown);
    }
  }
  return result.append(text);
}

}  // namespace

std::string escape_html(const std::string& text) {
  static const std::map<char, const char*> kEntities = {
      {'&', "&amp;"}, {'<', "&lt;"}, {'>', "&gt;"}, {'"', "&quot;"}, {'\'', "&#39;"}};
  std::string result;
  for (const char c : text) {
    const bool is_control = static_cast<unsigned char>(c) < 0x20 && c != '\n' && c != '\t';
    if (const auto entity = kEntities.find(c); entity != kEntities.end())
      result += entity->second;
    else
      result += is_control ? ' ' : c;
  }
  return result;
}

std::string render(std::string_view text, const Json& data) {
  return render(text, Sections{&data});
}

}  // namespace bodyschema
