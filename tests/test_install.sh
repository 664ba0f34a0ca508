#!/bin/sh
# Installs into a fresh prefix, moves it, and builds and runs a consumer four ways: find_package()
# and pkg-config, shared and static.
#   test_install.sh BUILD_FOLDER SCRATCH_FOLDER CC CXX
set -eu
build=$1 scratch=$2 cc=$3 cxx=$4

rm -rf "$scratch"
mkdir -p "$scratch/consumer"
cmake --install "$build" --prefix "$scratch/first" >"$scratch/install.log"
mv "$scratch/first" "$scratch/prefix" # the tree must not know where it was installed
prefix=$scratch/prefix

cat >"$scratch/consumer/main.c" <<'C'
#include <stdio.h>
#include "kinegrad/correct.h"
#include "kinegrad/metrics.h"
int main(void)
{
  kg_clip *clip = NULL;
  kg_subject *subject = NULL;
  kg_correct_result *result = NULL;
  const kg_clip_def def = kg_clip_default_def();
  const kg_subject_def subject_def = kg_subject_default_def();
  const kg_correct_def correct_def = kg_correct_default_def();
  kg_error error;
  if (kg_clip_read(&clip, "no such file", &def, &error) != KG_ERR_READ) {
    return 1;
  }
  if (clip && kg_subject_create(&subject, clip, &subject_def, &error) == KG_OK &&
      kg_correct(&result, subject, &correct_def, &error) == KG_OK) {
    return 2;
  }
  printf("%.4f\n", kg_metric_validity(1.0, 0.001));
  return 0;
}
C
# the engine alone, C and OpenBLAS: d(x sin x)/dx at x = 2 is sin 2 + 2 cos 2 = 0.0770
cat >"$scratch/consumer/engine.c" <<'C'
#include <kinegrad/derivatives.h>
#include <stdio.h>

int main(void)
{
  kg_tape *tape;
  if (kg_tape_create(NULL, &tape, NULL) != KG_OK) {
    return 1;
  }
  const kg_value x = kg_scalar(tape, 2.0), y = kg_mul(tape, x, kg_sin(tape, x));
  if (kg_backward(tape, y) != KG_OK) {
    return 2;
  }
  printf("%.4f\n", kg_adjoint_item(tape, x));
  kg_tape_destroy(tape);
  return 0;
}
C
cat >"$scratch/consumer/CMakeLists.txt" <<'CMAKE'
cmake_minimum_required(VERSION 3.21)
project(consumer LANGUAGES C CXX)
find_package(kinegrad 0.1 REQUIRED COMPONENTS static)
add_executable(with_shared main.c)
target_link_libraries(with_shared PRIVATE kinegrad::kinegrad)
add_executable(with_static main.c)
target_link_libraries(with_static PRIVATE kinegrad::kinegrad_static)
add_executable(with_engine engine.c)
target_link_libraries(with_engine PRIVATE kinegrad::kinegrad_autodiff)
CMAKE

# ... and with nothing but a C compiler
mkdir -p "$scratch/engine"
cat >"$scratch/engine/CMakeLists.txt" <<'CMAKE'
cmake_minimum_required(VERSION 3.21)
project(engine LANGUAGES C)
find_package(kinegrad 0.1 REQUIRED COMPONENTS autodiff)
add_executable(engine ../consumer/engine.c)
target_link_libraries(engine PRIVATE kinegrad::kinegrad_autodiff)
CMAKE

check() { # NAME COMMAND...: the consumer runs and gives the number computed by hand
  name=$1
  shift
  expect "$name" 0.9038 "$@" # 1 - 0.0731 * 1 - 0.0231 * 1 (mm)
}

expect() { # NAME ANSWER COMMAND...
  name=$1 expected=$2
  shift 2
  answer=$("$@")
  if [ "$answer" != "$expected" ]; then
    echo "$name: got '$answer', expected $expected" >&2
    exit 1
  fi
  echo "$name: good"
}

cmake -G Ninja -S "$scratch/consumer" -B "$scratch/build" -DCMAKE_PREFIX_PATH="$prefix" \
  -DCMAKE_C_COMPILER="$cc" -DCMAKE_CXX_COMPILER="$cxx" >"$scratch/configure.log"
cmake --build "$scratch/build" >"$scratch/build.log"
check "find_package, shared" "$scratch/build/with_shared"
check "find_package, static" "$scratch/build/with_static"
expect "find_package, the engine alone" 0.0770 "$scratch/build/with_engine"

cmake -G Ninja -S "$scratch/engine" -B "$scratch/engine_build" -DCMAKE_PREFIX_PATH="$prefix" \
  -DCMAKE_C_COMPILER="$cc" >"$scratch/engine_configure.log"
cmake --build "$scratch/engine_build" >"$scratch/engine_build.log"
expect "find_package, component autodiff" 0.0770 "$scratch/engine_build/engine"

PKG_CONFIG_PATH=$(dirname "$(find "$prefix" -name kinegrad.pc)")
export PKG_CONFIG_PATH
libdir=$(pkg-config --variable=libdir kinegrad)
# shellcheck disable=SC2046 # flags are words
"$cc" "$scratch/consumer/main.c" -o "$scratch/pc_shared" $(pkg-config --cflags --libs kinegrad)
check "pkg-config, shared" env LD_LIBRARY_PATH="$libdir" "$scratch/pc_shared"
# shellcheck disable=SC2046
"$cc" "$scratch/consumer/main.c" -o "$scratch/pc_static" $(pkg-config --cflags kinegrad) \
  $(pkg-config --static --libs kinegrad | sed 's/-lkinegrad/-l:libkinegrad.a/')
check "pkg-config, static" "$scratch/pc_static"

# shellcheck disable=SC2046
"$cc" "$scratch/consumer/engine.c" -o "$scratch/pc_engine" \
  $(pkg-config --cflags --libs kinegrad_autodiff)
expect "pkg-config, the engine alone" 0.0770 "$scratch/pc_engine"

check_version() {
  case $("$prefix/bin/kinegrad" --version) in
    "kinegrad $(pkg-config --modversion kinegrad)") echo "command: good" ;;
    *)
      echo "the installed command and pkg-config disagree on the version" >&2
      exit 1
      ;;
  esac
}
check_version

if ! [ -s "$prefix/share/doc/kinegrad/docs/guide/read-the-report.md" ]; then
  echo "the guide is not installed beside the README that points to it" >&2
  exit 1
fi
if ! [ -s "$prefix/share/doc/kinegrad/examples/first_gradient.c" ]; then
  echo "the examples are not installed where the guide's links lead" >&2
  exit 1
fi
echo "documents: good"

# nothing but the interface is exported
extra=$(nm -D --defined-only "$libdir"/libkinegrad.so | awk '$2 ~ /[TDBR]/ && $3 !~ /^kg_/ {print $3}' | head -3)
if [ -n "$extra" ]; then
  echo "exported although it is not part of the interface: $extra" >&2
  exit 1
fi
echo "exported names: good"
