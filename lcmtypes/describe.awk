# Writes describe() of every type (field_kinds.h), and for_each_type(visit), from the .lcm files. The kind of a field
# stands in braces at the beginning of its comment:
#   {0..1}  {-1..}                 range of a number, or of the length of a text [bytes]
#   {KIND_POSITION..KIND_RELEASE}  constants of this type; of another {schema_edge_t.EDGE_OK..EDGE_INVALID}
#   {measured}                     Measured{} of field_kinds.h; likewise any other word
# Without braces: an integer >= 0, a finite number, a text of at most 1 MB.
function kind_of(type, text, owner) {
  if (text == "") return type ~ /^int/ ? "Range(0)" : type == "string" ? "Range(0, 1e6)" : "Any{}"
  if (text !~ /[.][.]/) return toupper(substr(text, 1, 1)) substr(text, 2) "{}"
  if (text ~ /^[-0-9]/) { sub(/[.][.]/, ", ", text); sub(/, $/, "", text); return "Range(" text ")" }
  owner = text ~ /_t[.]/ ? text : struct
  sub(/[.].*/, "", owner); sub(/.*[.][.]/, "", text)
  return "Constant{" owner "::" text "}"
}

BEGIN {
  print "#pragma once\n\n#include \"bodyschema/field_kinds.h\""
  for (i = 1; i < ARGC; ++i) { name = ARGV[i]; gsub(/.*\/|[.]lcm/, "", name); print "#include \"bodyschema/" name ".hpp\"" }
  print "\nnamespace bodyschema {\n"
}
/^struct / { struct = $2; types = types "  visit(" struct "{});\n"; print "void describe(auto& v, Is<" struct "> auto& m) {" }
/^}/ { print "}\n" }
/^  [a-z]/ && $1 != "const" {
  name = $2; sub(/[[;].*/, "", name)
  count = match($2, /num_[a-z_]*\]/) ? ", m." substr($2, RSTART, RLENGTH - 1) : ""
  text = match($0, /\/\/ [{][^}]*/) ? substr($0, RSTART + 4, RLENGTH - 4) : ""
  kind = $1 ~ /^(int|byte|float|double|string)/ ? ", " kind_of($1, text) : ""
  print "  v" (count ? ".array" : "") "(\"" name "\"" count ", m." name kind ");"
}
END { print "void for_each_type(auto visit) {\n" types "}\n\n}  // namespace bodyschema" }
