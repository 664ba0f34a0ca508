#!/usr/bin/env bash
# Code and output quoted in README.md and docs/guide are those of the examples: test_docs.sh SOURCE EXAMPLES
#
#   <!-- examples/FILE.c [REGION] -->   the fenced block below equals the lines of the file between
#                                       two comments /* [REGION] */, less their common indent
#   <!-- output of NAME -->             the fenced block below is printed by that example
#
# A page links to every example it quotes from, and names the headers the example includes.
set -euo pipefail
source=$1 examples=$2
failed=0

fail() {
  echo "FAILED: $1" >&2
  failed=1
}

# region FILE NAME
region() {
  awk -v mark="/* [$2] */" '
    { line = $0; sub(/^ */, "", line) }
    line == mark { inside = !inside; if (inside) indent = length($0) - length(line); next }
    inside { print substr($0, (substr($0, 1, indent) ~ /^ *$/ ? indent : 0) + 1) }' "$1"
}

# block PAGE MARKER: the fenced block right below the marker
block() {
  awk -v mark="$2" '
    inside && /^```/ { exit }
    inside { print }
    $0 == mark { getline; if (/^```/) inside = 1 }' "$1"
}

quotes=0
for page in "$source"/README.md "$source"/docs/guide/*.md; do
  while IFS= read -r marker; do
    quotes=$((quotes + 1))
    quoted=$(block "$page" "$marker")
    [[ -n $quoted ]] || fail "$page: no block below $marker"
    if [[ $marker =~ ^\<!--\ (examples/[a-z_]+\.c)\ \[([a-z]+)\]\ --\>$ ]]; then
      [[ $quoted == "$(region "$source/${BASH_REMATCH[1]}" "${BASH_REMATCH[2]}")" ]] ||
        fail "$page: differs from ${BASH_REMATCH[1]} [${BASH_REMATCH[2]}]"
    elif [[ $marker =~ ^\<!--\ output\ of\ ([a-z_]+)\ --\>$ ]]; then
      output=$("$examples/${BASH_REMATCH[1]}" 2>/dev/null) || fail "${BASH_REMATCH[1]} failed"
      [[ $'\n'$output$'\n' == *$'\n'"$quoted"$'\n'* ]] ||
        fail "$page: not printed by ${BASH_REMATCH[1]}"
    else
      fail "$page: $marker"
    fi
  done < <(grep -E '^<!-- (examples/|output of )' "$page")
  for example in $(sed -nE 's/^<!-- (examples\/[a-z_]+\.c) .*/\1/p' "$page" | sort -u); do
    grep -qE "\]\((\.\./\.\./)?$example\)" "$page" || fail "$page: no link to $example"
    for header in $(sed -n 's/^#include "\(.*\)"$/\1/p' "$source/$example"); do
      grep -qF "\`$header\`" "$page" || fail "$page: $example includes $header, which is not said"
    done
  done
  awk '/^```c$/ && previous !~ /^<!-- examples\// { print FILENAME ":" FNR; bad = 1 }
    { previous = $0 } END { exit bad }' "$page" || fail "C code that is no example's"
done
((quotes >= 17)) || fail "only $quotes quotations found"
exit $failed
