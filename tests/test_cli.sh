#!/bin/sh
# The command from outside: exit codes, streams, bad input, atomic output, reports, help.
#   test_cli.sh KINEGRAD JSON_GET DATA_FOLDER SCRATCH_FOLDER
set -u
kinegrad=$(realpath "$1") json_get=$(realpath "$2") data=$(realpath "$3") scratch=$4
failures=0 claims=0

rm -rf "$scratch"
mkdir -p "$scratch/out"
cd "$scratch" || exit 1
walk=$scratch/walk.bvh
# someone who stands and waves: the joints of walker.bvh in their rest pose, the left arm moves
awk '/^MOTION/ {exit} {print} /ROOT|JOINT/ {name = $2} /CHANNELS/ {
    if (name == "LeftArm") arm = n
    n += $2}
  END {print "MOTION\nFrames: 48\nFrame Time: 0.0083333333"
    for (t = 0; t < 48; t++) {
      for (i = 0; i < n; i++) {
        v = 0
        if (i == 1) v = 100
        if (i == arm) v = 30 + 10 * cos(0.13 * t)
        printf "%.6f ", v}
      print ""}}' "$data/walker.bvh" >"$walk"

fail() {
  failures=$((failures + 1))
  echo "FAILED: $*" >&2
}

claim() { # WHAT COMMAND...: the command succeeds
  what=$1
  shift
  claims=$((claims + 1))
  "$@" >/dev/null || fail "$what"
}

run() { # CODE ARGUMENT...: exit code as expected; streams in stdout.txt and stderr.txt
  expected=$1
  shift
  claims=$((claims + 1))
  "$kinegrad" "$@" >stdout.txt 2>stderr.txt
  code=$?
  if [ $code -ne "$expected" ]; then
    fail "kinegrad $*: exit code $code, expected $expected"
    sed 's/^/    /' stderr.txt >&2
  fi
}

says() { # PATTERN: the one line on stderr
  claims=$((claims + 1))
  if [ "$(wc -l <stderr.txt)" -ne 1 ] || ! grep -Eq -- "$1" stderr.txt; then
    fail "expected one message like '$1', got:"
    sed 's/^/    /' stderr.txt >&2
  fi
}

nothing_in() { # FOLDER: empty, hidden files included
  claims=$((claims + 1))
  left=$(find "$1" -mindepth 1 | head -3)
  [ -z "$left" ] || fail "left behind: $left"
}

silent() {
  claims=$((claims + 1))
  [ ! -s stdout.txt ] || fail "stdout has text although the command failed"
}

# ---- usage ---------------------------------------------------------------------------------------

run 2
says "a command is missing"
run 2 corect
says "unknown command 'corect'; did you mean 'correct'\?"
run 2 frobnicate
says "unknown command 'frobnicate'; 'kinegrad --help'"
run 2 train
says "unknown command 'train'"
run 2 --verbose
says "a command comes first"
run 2 info
says "takes one clip, 0 given"
run 2 info a.bvh b.bvh
says "takes one clip, 2 given"
run 2 info "$walk" --untis 1
says "unknown option --untis of 'info'; did you mean --unit\?"
run 2 info "$walk" -unit 1
says "unknown option --unit"
run 2 info "$walk" --keep-first-frame=1
says "keep-first-frame takes no value"
run 2 info "$walk" --unit
says "unit needs a value"
run 2 info "$walk" --json --quiet
says "json needs a value"
run 2 info "$walk" --up=w
says "up: 'w' is none of"
for bad in nan inf 0x1p3 1e400 abc 1,5 "" "1 "; do
  run 2 info "$walk" --unit "$bad"
  says "--unit: '.*' is not a number \(m per unit"
done
run 2 info "$walk" --mass -3
says "--mass: -3 is out of range, expected 1 to 1000 \(kg\)"
run 2 correct "$walk" -o out/x.bvh --threads 1.5
says "--threads: '1.5' is not a whole number"
run 2 correct "$walk" -o out/x.bvh --threads 99999999999999999999
says "--threads: .* is out of range"
run 2 correct "$walk"
says "needs a file to write"
run 2 correct "$walk" -o out/x.fbx
says "does not end in .bvh"
for option in "--forces f.csv" "--dt 0.01" "--gravity 9.81"; do
  # shellcheck disable=SC2086 # two words
  run 2 correct "$walk" -o out/x.bvh --method sdf $option
  says "has no meaning with --method sdf"
done
run 2 eval "$walk"
says "takes a capture and an output, 1 given"
run 2 eval "$walk" "$scratch"
says "two clips or two folders"
run 2 gradcheck --filter no_such_operator
says "no check has 'no_such_operator' in its name"
run 2 gradcheck --filter matmul,no_such_operator,sin
says "no check has 'no_such_operator' in its name"
run 2 gradcheck --filter ,
says "no check has '' in its name"
run 2 gradcheck "$walk" "$walk"
says "takes at most one clip, 2 given"
run 2 gradcheck --points 0
says "--points: 0 is out of range"
run 2 gradcheck --filter sin --json "$walk" "$walk"
says "--json"
run 3 gradcheck no_such.bvh
silent
run 2 help exit-code
says "did you mean 'exit-codes'"
nothing_in out

# ---- help is made from the table -----------------------------------------------------------------

run 0 --help
claim "overview names every command" grep -Eq "^  correct +make" stdout.txt
claim "help goes to stdout" test ! -s stderr.txt
run 0 --version
claim "version" grep -Eq "^kinegrad [0-9]+\.[0-9]+\.[0-9]+$" stdout.txt
for topic in formats scenes units exit-codes json roles info correct eval gradcheck; do
  run 0 help $topic
  claim "help $topic says something" test "$(wc -l <stdout.txt)" -ge 5
done
run 0 help scenes
claim "help scenes has the types and their members" \
  grep -Eq '^  capsule +from_m, to_m, radius_m$' stdout.txt
claim "and no line over 100 columns" awk 'length > 100 {exit 1}' stdout.txt
run 0 help json
claim "help json has the keys" grep -q momentum_balance stdout.txt
commands="info correct eval gradcheck"
"$kinegrad" bench -h >/dev/null 2>&1 && commands="$commands bench"
for command in $commands; do
  run 0 $command -h
  grep -oE -- '--[a-z-]+' stdout.txt | sort -u >short.txt
  cp stdout.txt short_text.txt
  run 0 $command --help
  grep -oE -- '^ +(-[a-zA-Z], )?--[a-z-]+' stdout.txt | grep -oE -- '--[a-z-]+' | sort -u >long.txt
  claim "$command: -h and --help name the same options" test -z "$(comm -13 short.txt long.txt)"
  claim "$command: -h is shorter" test "$(wc -l <short_text.txt)" -lt "$(wc -l <stdout.txt)"
  claim "$command: no line of -h is over 100 columns" awk 'length > 100 {exit 1}' short_text.txt
  claim "$command: -h explains every option" test "$(grep -c '  --\|-., --' short_text.txt)" -ge 3
done
run 0 info --help
claim "units and ranges stand in --help" grep -q "unit: kg; range: 1 to 1000" stdout.txt

# ---- every example in --help runs ----------------------------------------------------------------

mkdir -p examples/captures examples/corrected
cp "$walk" examples/walk.bvh
awk '/^Frame Time/ {print; data = 1; next} data && NF > 3 {$1 += 300} {print}' "$walk" >examples/partner.bvh
printf '{"shapes": [{"type": "box", "center_m": [0, 0.5, 9], "size_m": [1, 1, 1]}]}' >examples/gym.json
cp "$walk" examples/captures/walk.bvh
cp "$walk" examples/corrected/walk.bvh
for command in $commands; do
  "$kinegrad" $command --help | sed -n '/^Examples:/,$p' | sed -n 's/^  kinegrad //p' >examples.txt
  claim "$command has examples" test -s examples.txt
  while read -r line; do
    claims=$((claims + 1))
    # shellcheck disable=SC2086 # a command line is words
    (cd examples && "$kinegrad" $line >example_out.txt 2>example_err.txt) || {
      fail "example: kinegrad $line"
      cat examples/example_err.txt >&2
    }
  done <examples.txt
done

# ---- info ----------------------------------------------------------------------------------------

run 0 info "$walk"
for line in "unit  " "up axis  " "first frame  " "floor  " "body  .*70.00 kg" "mapping  " \
  "pelvis  *Hips" "left foot .*ground in [0-9]+ %"; do
  claim "info prints $line" grep -Eq "$line" stdout.txt
done
claim "info says why, once" grep -Eq "^  first frame  motion: joints turn" stdout.txt
run 0 info "$walk" --json -
cp stdout.txt info.json
claim "info --json - is JSON and nothing else" "$json_get" info.json
claim "frames" test "$("$json_get" info.json clip.frame_count)" = 48
claim "pelvis" test "$("$json_get" info.json mapping.pelvis)" = '"Hips"'
run 0 info "$walk" --mass 60 --unit 0.02 --up y --floor -0.125 --json=info2.json
claim "info --json FILE" "$json_get" info2.json
claim "the text stays with --json FILE" grep -q "given" stdout.txt
claim "unit given" test "$("$json_get" info2.json clip.unit_m)" = 0.02
claim "floor given" test "$("$json_get" info2.json floor.height_m)" = -0.125
"$json_get" info2.json segments.mass_kg | tr -d '[] ' >masses.txt
# shellcheck disable=SC2016 # the dollars are awk's
claim "segment masses add up to the mass" awk -F, \
  '{for (i = 1; i <= NF; i++) m += $i} END {exit !(m > 60 - 1e-9 && m < 60 + 1e-9)}' masses.txt
run 0 info "$walk" --joints
claim "--joints lists all 31" test "$(wc -l <stdout.txt)" -eq 31
run 0 info --joints -- "$walk"
run 0 info "$walk" --mjcf body.xml
claim "the MJCF file is one" grep -q "<mujoco" body.xml
run 0 info "$walk" --floor 0.5 --mjcf body.xml
claim "its ground is the clip's" grep -q 'name="ground".* pos="0 0.5 0"' body.xml
claim "a closed pipe is no error" sh -c "'$kinegrad' info '$walk' --json - | head -c 1 >/dev/null"
if [ -c /dev/full ]; then
  claims=$((claims + 1))
  "$kinegrad" info "$walk" >/dev/full 2>stderr.txt
  [ $? -eq 4 ] || fail "a full stdout must be exit code 4"
  says "standard output cannot be written"
fi

# ---- unreadable input: exit 3, one message file:line:column, no output ---------------------------

mkdir -p bad
: >bad/empty.bvh
printf '\211PNG\r\n\032\n\000\000\000\rIHDR' >bad/picture.bvh
head -20 "$walk" >bad/truncated_header.bvh
sed '/^Frame Time/q' "$walk" >bad/no_frame.bvh
(sed '/^Frame Time/q' "$walk"; echo "1 2 3") >bad/no_complete_frame.bvh
first=$(($(grep -n '^Frame Time' "$walk" | cut -d: -f1) + 1))
sed "$((first + 3))s/^[^ ]*/nan/" "$walk" >bad/nan.bvh
sed "$((first + 3))s/^[^ ]*/1e400/" "$walk" >bad/huge.bvh
sed 's/^Frame Time:.*/Frame Time: -0.01/' "$walk" >bad/negative_time.bvh
sed 's/^Frame Time:.*/Frame Time: 0/' "$walk" >bad/zero_time.bvh
sed '0,/CHANNELS 6 Xposition/s//CHANNELS 7 Xposition Xposition/' "$walk" >bad/seven_channels.bvh
awk 'BEGIN {
  print "HIERARCHY"; print "ROOT j"; for (i = 0; i < 100000; i++) {
    print "{\nOFFSET 0 1 0\nCHANNELS 3 Zrotation Xrotation Yrotation\nJOINT j" i } }' >bad/deep.bvh

for file in empty picture truncated_header no_frame no_complete_frame nan huge negative_time \
  zero_time seven_channels deep; do
  run 3 correct "bad/$file.bvh" -o out/x.bvh --json out/x.json --forces out/x.csv
  says "^kinegrad: bad/$file\.bvh:[0-9]+:([0-9]+:)? .*(expected|, .*)"
  silent
  nothing_in out
  run 3 info "bad/$file.bvh"
  silent
done
says_line() { # LINE: the message points at it
  claims=$((claims + 1))
  grep -q ":$1:" stderr.txt || fail "expected the message to point at line $1: $(cat stderr.txt)"
}
run 3 info bad/nan.bvh
says_line $((first + 3))
run 3 info bad/negative_time.bvh
says_line $((first - 1))

printf ':FULLY-SPECIFIED\n:DEGREES\n1\nroot 0 0 0 0 0 0\n' >bad/alone.amc
run 3 correct bad/alone.amc -o out/x.bvh
says "^kinegrad: bad/.*(ASF|asf)"
nothing_in out
sed 's/LeftUpLeg/Bone7/; s/RightArm/Bone9/' "$walk" >bad/names.bvh
run 3 correct bad/names.bvh -o out/x.bvh
says "^kinegrad: bad/names\.bvh: .*l_hip.*map"
claim "every missing role is named" grep -q r_shoulder stderr.txt
nothing_in out
run 0 info bad/names.bvh --joints
printf 'l_hip = Bone7\nr_shoulder = Bone9\n' >names.map
run 0 info bad/names.bvh --map names.map
run 3 info bad/names.bvh --map no_such.map
says "no_such\.map"
run 3 info no_such_file.bvh
says "^kinegrad: no_such_file\.bvh: .*No such file"
run 3 info "$scratch"
run 3 correct "$walk" -o out/x.bvh --scene no_such.obj
says "no_such\.obj"
printf 'v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n' >bad/index.obj
run 3 correct "$walk" -o out/x.bvh --scene bad/index.obj
says "bad/index\.obj"
nothing_in out

# ---- outputs that cannot be written: exit 4, before the computation, all or nothing --------------

run 4 correct "$walk" -o no_such_folder/x.bvh
says "no_such_folder/x\.bvh: cannot be written: No such file"
mkdir -p out/folder.bvh
run 4 correct "$walk" -o out/folder.bvh
says "it is a folder"
rmdir out/folder.bvh
run 4 correct "$walk" -o out/x.bvh --json no_such_folder/x.json
nothing_in out
run 4 correct "$walk" -o out/x.bvh --json out/x.bvh
says "two outputs"
nothing_in out
if [ -c /dev/full ]; then
  for option in --json --forces; do
    run 4 correct "$walk" -o out/x.bvh $option /dev/full
    silent
    nothing_in out
  done
fi
# an input is not written over, whatever its name; the clip by its own correction alone
cp "$walk" clip.bvh
ln -s clip.bvh clip_link
ln clip.bvh clip_twin
printf 'v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n' >solid.bvh
: >empty.map
for option in "--json clip.bvh" "--json clip_link" "--forces clip_twin" "--json empty.map" "--json solid.bvh"; do
  # shellcheck disable=SC2086 # two words
  run 2 correct clip.bvh -o out/x.bvh --map empty.map --scene solid.bvh $option
  says "is read by this run"
done
run 2 correct clip.bvh -o solid.bvh --scene solid.bvh
says "output: 'solid.bvh' is read by this run"
run 2 info clip.bvh --json clip.bvh
run 2 info clip.bvh --mjcf clip_link
run 2 eval clip.bvh "$walk" --json clip_twin
run 2 eval "$walk" clip.bvh --json clip.bvh
claim "the inputs are as they were" cmp "$walk" clip.bvh
silent
nothing_in out
run 4 info "$walk" --mjcf no_such_folder/x.xml
run 4 eval "$walk" "$walk" --json no_such_folder/x.json

# an existing file survives a failure
echo precious >out/x.bvh
run 3 correct bad/nan.bvh -o out/x.bvh
claim "an existing file survives bad input" grep -q precious out/x.bvh
run 3 correct "$walk" -o out/x.bvh --scene no_such.obj
claim "an existing file survives a bad scene" grep -q precious out/x.bvh
claim "and nothing else is there" test "$(find out -mindepth 1 | wc -l)" -eq 1
rm out/x.bvh

# ---- correct -------------------------------------------------------------------------------------

# ---- scenes that are described -------------------------------------------------------------------

printf 'v -9 -1 -9\nv 9 -1 -9\nv 9 -1 9\nv -9 -1 9\nv 0 -2 0\nf 1 4 3 2\nf 1 2 5\nf 2 3 5\nf 3 4 5\nf 4 1 5\n' >pit.obj
cat >gym.json <<'END'
{
  "floor": {"soft": {"thickness_m": 0.03, "stiffness_N_per_m": 20000}},
  "shapes": [
    {"type": "box", "center_m": [2, 0.5, 0], "size_m": [1, 1, 1], "rotation_deg": [0, 30, 0]},
    {"type": "mat", "center_m": [0, 0.05, 2], "size_m": [2, 0.1, 1], "soft": {"thickness_m": 0.1}},
    {"type": "sphere", "center_m": [0, 0.9, 3], "radius_m": 0.12, "velocity_m_per_s": [0, 0, -6]},
    {"type": "capsule", "from_m": [-1, 1, 1], "to_m": [1, 1, 1], "radius_m": 0.03},
    {"type": "cylinder", "from_m": [-1, 0, -2], "to_m": [-1, 1, -2], "radius_m": 0.3,
     "soft": {"thickness_m": 0.02, "stiffness_N_per_m": 5e3, "damping_s_per_m": 1, "friction": 0.4}},
    {"type": "ellipsoid", "center_m": [3, 0.3, 3], "semi_axes_m": [0.5, 0.3, 0.4]},
    {"type": "plane", "point_m": [0, 0, -4], "normal": [0, 0, 1]},
    {"type": "mesh", "file": "pit.obj", "unit_m": 0.5, "at_m": [0, -3, 0]}
  ]
}
END
run 0 correct "$data/walker.bvh" -o out/hard.bvh --method sdf --json out/hard.json --quiet
run 0 correct "$data/walker.bvh" -o out/gym.bvh --method sdf --scene gym.json --json out/gym.json --quiet
claim "the report counts shapes" test "$("$json_get" out/gym.json scene.shape_count)" = 9
claim "soft ones" test "$("$json_get" out/gym.json scene.soft_count)" = 3
claim "and moving ones" test "$("$json_get" out/gym.json scene.moving_count)" = 1
printf '{"floor": {"soft": {"thickness_m": 0.03}}}' >soft.json
run 0 correct "$data/walker.bvh" -o out/soft.bvh --method sdf --scene soft.json --json out/soft.json --quiet
claim "the capture is 30 mm less deep in the core" sh -c \
  'awk -v a="$("$0" out/hard.json capture.penetration_max_m)" -v b="$("$0" out/soft.json capture.penetration_max_m)" \
   "BEGIN {d = a - b - 0.03; exit !(d < 1e-9 && d > -1e-9)}"' "$json_get"
claim "the ball that flies at the walker meets a leg at the end" sh -c \
  'awk -v f="$("$0" out/gym.json capture.penetration_frame)" -v a="$("$0" out/soft.json capture.penetration_max_m)" \
   -v b="$("$0" out/gym.json capture.penetration_max_m)" "BEGIN {exit !(f > 40 && b > a + 0.01)}"' "$json_get"
# a wall through the walker: the same box as a file and as a mesh say the same
printf '{"shapes": [{"type": "box", "center_m": [0.9, 1, 0], "size_m": [1.4, 2, 4]}]}' >wall.json
printf 'v 0.2 0 -2\nv 1.6 0 -2\nv 1.6 2 -2\nv 0.2 2 -2\nv 0.2 0 2\nv 1.6 0 2\nv 1.6 2 2\nv 0.2 2 2\n%s' \
  'f 4 3 2 1
f 5 6 7 8
f 1 2 6 5
f 3 4 8 7
f 2 3 7 6
f 4 1 5 8
' >wall.obj
run 0 correct "$data/walker.bvh" -o out/w1.bvh --method sdf --scene wall.json --json out/w1.json --quiet
run 0 correct "$data/walker.bvh" -o out/w2.bvh --method sdf --scene wall.obj --json out/w2.json --quiet
for key in capture.penetration_max_m capture.penetration_events; do
  claim "the box as a shape and as a mesh: $key" sh -c \
    'awk -v a="$("$0" out/w1.json $1)" -v b="$("$0" out/w2.json $1)" -v c="$("$0" out/hard.json $1)" \
     "BEGIN {exit !(a - b < 1e-6 && b - a < 1e-6 && a > c)}"' "$json_get" "$key"
done
# the same wall once more: a longer one without its end, and the end of a longer one
printf '{"shapes": [{"type": "difference", "at_m": [0.9, 1, 0], "of": [
  {"type": "box", "center_m": [0.5, 0, 0], "size_m": [2.4, 2, 4]},
  {"type": "plane", "point_m": [0.7, 0, 0], "normal": [-1, 0, 0]}]}]}' >cut.json
printf '{"shapes": [{"type": "intersection", "of": [
  {"type": "box", "center_m": [0.9, 1, 0], "size_m": [1.4, 2, 9]},
  {"type": "box", "center_m": [0.4, 1, 0], "size_m": [2.4, 2, 4]}, {"type": "plane", "point_m": [0.2, 0, 0], "normal": [-1, 0, 0]}]}]}' >both.json
for file in cut both; do
  run 0 correct "$data/walker.bvh" -o out/w3.bvh --method sdf --scene $file.json --json out/w3.json --quiet
  claim "$file.json is one shape" test "$("$json_get" out/w3.json scene.shape_count)" = 2
  for key in capture.penetration_max_m capture.penetration_events; do
    claim "$file.json is the wall: $key" sh -c \
      'awk -v a="$("$0" out/w1.json $1)" -v b="$("$0" out/w3.json $1)" "BEGIN {exit !(a - b < 1e-6 && b - a < 1e-6)}"' \
      "$json_get" "$key"
  done
done
# LINE:COLUMN, the message, the file
while IFS='|' read -r place message text; do
  printf '%b' "$text" >wrong.json
  run 3 correct "$data/walker.bvh" -o out/x.bvh --scene wrong.json
  says "wrong.json:$place: $message"
done <<'END'
2:50|"size_m": expected .x, y, z., each from|{"shapes": [\n  {"type": "box", "center_m": [0,0,0], "size_m": [1,1]}]}
2:12|"type": .*did you mean "box"|{"shapes": [\n  {"type": "bxo"}]}
2:22|unknown member "radius"; did you mean "radius_m"|{"shapes": [\n  {"type": "sphere", "radius": 1}]}
2:3|"center_m" is missing|{"shapes": [\n  {"type": "sphere", "radius_m": 1}]}
2:30|not JSON|{"shapes": [\n  {"type": "sphere" "radius_m": 1}]}
1:37|not JSON: duplicate|{"shapes": [{"type": "sphere", "type": "box"}]}
2:85|"thickness_m": .*rigid core|{"shapes": [\n  {"type": "box", "center_m": [0,0,0], "size_m": [1,0.1,1], "soft": {"thickness_m": 0.09}}]}
1:95|"thickness_m": expected no more than the height|{"shapes": [{"type": "mat", "center_m": [0,0,0], "size_m": [1,0.1,1], "soft": {"thickness_m": 0.2}}]}
1:13|"soft" is missing|{"shapes": [{"type": "mat", "center_m": [0,0,0], "size_m": [1,0.1,1]}]}
1:44|"center_m": expected|{"shapes": [{"type": "sphere", "center_m": [0,0,1e99], "radius_m": 1}]}
1:2|unknown member "shape"|{"shape": []}
1:1|expected an object|[1]
1:36|"thickness_m": expected a number|{"floor": {"soft": {"thickness_m": "x"}}}
1:11|"floor": expected an object|{"floor": 3}
1:13|expected an object with a "type"|{"shapes": [3]}
1:61|"to_m": expected another point|{"shapes": [{"type": "cylinder", "from_m": [0,0,0], "to_m": [0,0,0], "radius_m": 1}]}
END
printf '{"shapes": [{"type": "mesh", "file": "nowhere.obj"}]}' >wrong.json
run 3 correct "$data/walker.bvh" -o out/x.bvh --scene wrong.json
says "nowhere.obj"
# limits: the floor is one shape and may be soft, and none of it is the clip's mistake
shapes() { # COUNT MEMBERS
  printf '{"shapes": ['
  seq "$1" | while read -r i; do
    test "$i" = 1 || printf ','
    printf '{"type": "sphere", "center_m": [0, -50, %d], "radius_m": 1%s}' "$i" "$2"
  done
  printf ']}'
}
shapes 95 "" >many.json
run 0 correct "$data/walker.bvh" -o out/x.bvh --scene many.json --method sdf --quiet
run 3 correct "$data/walker.bvh" -o out/y.bvh --scene many.json --scene wall.obj
says "kinegrad: wall.obj: the scene has more than 95 shapes beside the floor"
shapes 96 "" >many.json
run 3 correct "$data/walker.bvh" -o out/y.bvh --scene many.json
says "many.json:1:[0-9]+: the scene has more than 95 shapes"
shapes 15 ', "soft": {"thickness_m": 0.1}' >many.json
run 0 correct "$data/walker.bvh" -o out/x.bvh --scene many.json --method sdf --quiet
shapes 16 ', "soft": {"thickness_m": 0.1}' >many.json
run 3 correct "$data/walker.bvh" -o out/y.bvh --scene many.json
says "many.json:1:[0-9]+: the scene has more than 15"
shapes 49 ', "velocity_m_per_s": [0, 0, 1]' >many.json
run 3 correct "$data/walker.bvh" -o out/y.bvh --scene many.json
says "many.json:1:[0-9]+: the scene has more than 48"
run 3 correct "$data/walker.bvh" -o out/y.bvh --scene gym.json --scene soft.json
says "soft.json:1:11: \"floor\" stands in gym.json too"
run 0 correct "$data/walker.bvh" -o out/x.bvh --method sdf --scene soft.json
claim "a soft floor alone in the table" grep -Eq "^  scene +soft floor$" stdout.txt
run 0 correct "$data/walker.bvh" -o out/x.bvh --method sdf --scene wall.json
claim "one shape in the table" grep -Eq "^  scene +floor and 1 shape, 0 soft, 0 moving$" stdout.txt
run 0 correct "$data/walker.bvh" -o out/x.bvh --method sdf --scene gym.json
claim "several" grep -Eq "^  scene +soft floor and 8 shapes, 2 soft, 1 moving$" stdout.txt
run 2 correct "$data/walker.bvh" -o out/x.bvh --scene gym.json --json gym.json
# nor the meshes of a description
cp pit.obj pit_kept.obj
for option in --json --forces; do
  run 2 correct "$data/walker.bvh" -o out/x.bvh --scene gym.json $option pit.obj
  says "pit.obj' is read by this run"
done
claim "the mesh is as it was" cmp pit.obj pit_kept.obj
# a name that is no UTF-8, a byte order mark, a byte 0, letters that a terminal obeys
odd_name=$(printf 'odd\377.obj')
run 3 correct "$data/walker.bvh" -o out/x.bvh --scene "$odd_name"
says "obj: cannot be opened: No such file or directory"
printf '\357\273\277{"shapes": 3}' >wrong.json
run 3 correct "$data/walker.bvh" -o out/x.bvh --scene wrong.json
says "wrong.json:1:12: \"shapes\": expected an array"
printf '{}\000{' >wrong.json
run 3 correct "$data/walker.bvh" -o out/x.bvh --scene wrong.json
says "wrong.json:1:3: not JSON"
printf '{"a\\u001b[2J\\nb": 1}' >wrong.json
run 3 correct "$data/walker.bvh" -o out/x.bvh --scene wrong.json
says 'unknown member "a\?\[2J\?b"'

# ---- another athlete -----------------------------------------------------------------------------

# the same walk 0.62 m (62 units) to the side: an arm is in the other's
awk '/^Frame Time/ {print; data = 1; next} data && NF > 3 {$1 += 62} {print}' "$data/walker.bvh" >beside.bvh
run 0 correct "$data/walker.bvh" -o out/two.bvh --method sdf --with beside.bvh --json out/two.json --quiet
claim "they were in each other" test "$("$json_get" out/two.json capture.other_frames)" = 15.0
claim "and are no longer" test "$("$json_get" out/two.json other_frames)" = 0.0
claim "the other is described" "$json_get" out/two.json other.clip.frame_count
run 0 correct "$data/walker.bvh" -o out/two.bvh --method sdf --with beside.bvh
claim "a row of it" grep -q "other_penetration_max_m" stdout.txt
run 0 correct "$data/walker.bvh" -o out/one.bvh --method sdf
claim "alone there is no such row" sh -c '! grep -q other_ stdout.txt'
awk '/^Frames:/ {print "Frames: 20"; next} /^Frame Time/ {print; data = 1; next}
  !data {print} data && n++ < 20 {print}' beside.bvh >brief.bvh
run 0 correct "$data/walker.bvh" -o out/two.bvh --method sdf --with brief.bvh
says "brief.bvh ends at 0.158 s"
run 3 correct "$data/walker.bvh" -o out/two.bvh --with no_such.bvh
run 0 correct "$data/walker.bvh" -o out/self.bvh --method sdf --self --json out/self.json
claim "--self: how deep the capture is in itself" \
  awk "BEGIN {exit !($("$json_get" out/self.json capture.self_penetration_max_m) > 0.01)}"
claim "--self: and the output no longer" \
  awk "BEGIN {exit !($("$json_get" out/self.json self_penetration_max_m) <= 1e-5)}"
claim "--self: in the table" grep -q "^  self_penetration_max_m " stdout.txt
run 0 correct "$data/walker.bvh" -o out/self.bvh --method sdf
claim "without --self: not in the table" test -z "$(grep self_ stdout.txt)"
run 2 correct "$data/walker.bvh" -o beside.bvh --with beside.bvh

# ---- what is left inside of something --------------------------------------------------------------

# four frames in a cell too small for two, the other 20 cm lower: nothing can be kept out of everything
awk '/^Frames:/ {print "Frames: 4"; next} /^Frame Time/ {print; data = 1; next}
  !data {print} data && n++ < 4 {print}' "$data/walker.bvh" >four.bvh
awk '/^Frame Time/ {print; data = 1; next} data && NF > 3 {$2 -= 20} {print}' four.bvh >lower.bvh
printf '{"shapes": [{"type": "plane", "point_m": [0, 0.4, 0], "normal": [0, -1, 0]},
  {"type": "plane", "point_m": [-0.2, 0, 0], "normal": [1, 0, 0]},
  {"type": "plane", "point_m": [0.2, 0, 0], "normal": [-1, 0, 0]},
  {"type": "plane", "point_m": [0, 0, -0.2], "normal": [0, 0, 1]},
  {"type": "plane", "point_m": [0, 0, 0.2], "normal": [0, 0, -1]}]}' >cell.json
run 1 correct four.bvh -o out/left.bvh --method sdf --scene cell.json --with lower.bvh --self \
  --json out/left.json --quiet
claim "the file is written all the same" test -s out/left.bvh
left() { # KEY WHERE: what is said of it is what the report says
  claim "$1: the report says how deep" awk "BEGIN {exit !($("$json_get" out/left.json "$1_max_m") > 1e-3)}"
  frame=$("$json_get" out/left.json "$1_frame")
  claim "$1: the frame with that depth" test \
    "$("$json_get" out/left.json "frames.$1_m.$frame")" = "$("$json_get" out/left.json "$1_max_m")"
  parts=$("$json_get" out/left.json "$1_segments" | tr -d '[]" ' | sed 's/,/ in /')
  depth=$("$json_get" out/left.json "$1_max_m" | awk '{printf "%.1f", 1e3 * $1}')
  claim "$1: told with depth, frame and body parts" grep -q \
    "four.bvh: the output is inside $2 by more than 1 mm in frame.*, at most by $depth mm in frame $frame ($parts); out/left.bvh was written" \
    stderr.txt
}
left penetration "the scene"
left other_penetration "the other athlete"
left self_penetration "itself"
claim "of two bodies two segments" test "$("$json_get" out/left.json other_penetration_segments.1 || echo none)" != none
claim "in the scene one" test "$("$json_get" out/left.json penetration_segments.1 || echo none)" = none
run 0 eval four.bvh out/left.bvh --scene cell.json --with lower.bvh --self
claim "eval tells where, too" grep -Eq "^  output's self_penetration_max_m: [0-9.]+ mm in frame [0-3] \([a-z0-9_]+ in [a-z0-9_]+\)$" stdout.txt

# a gap of 16 cm, narrower than a chest: nothing else is wrong with the result
printf '{"shapes": [{"type": "plane", "point_m": [0, 0, -0.08], "normal": [0, 0, 1]},
  {"type": "plane", "point_m": [0, 0, 0.08], "normal": [0, 0, -1]}]}' >gap.json
run 1 correct four.bvh -o out/left.bvh --method sdf --scene gap.json
says "inside the scene by more than 1 mm in frames 0-3, at most by [12][0-9]\.[0-9] mm in frame [0-3] \([a-z0-9_]+\)"

# eval measures against what a clip was corrected for
run 0 correct "$data/walker.bvh" -o out/all.bvh --method sdf --scene gym.json --with beside.bvh --self --json out/all.json --quiet
run 0 eval "$data/walker.bvh" out/all.bvh --scene gym.json --with beside.bvh --self --json out/eval.json --quiet
for key in penetration_max_m penetration_mean_m slip_m momentum_balance other_penetration_max_m self_penetration_max_m \
  frames.self_penetration_m.20 scene.shape_count scene.moving_count other.clip.frame_count; do
  claim "eval with everything in the way agrees on $key" \
    test "$("$json_get" out/eval.json $key)" = "$("$json_get" out/all.json $key)"
done
for key in penetration_max_m penetration_mean_m penetration_frame penetration_segments.0 other_frames \
  other_penetration_mean_m other_penetration_segments.1 self_penetration_mean_m self_penetration_frame self_penetration_segments.1; do
  claim "eval agrees on the capture's $key" \
    test "$("$json_get" out/eval.json capture.$key)" = "$("$json_get" out/all.json capture.$key)"
done
run 0 eval "$data/walker.bvh" "$data/walker.bvh" --json out/eval.json
claim "eval: nobody in the way unless asked" test "$("$json_get" out/eval.json self_penetration_max_m)" = null
claim "eval: and no array of it" test "$("$json_get" out/eval.json frames.self_penetration_m || echo none)" = none
claim "eval: the floor alone" test "$("$json_get" out/eval.json scene.shape_count)" = 1
run 0 eval "$data/walker.bvh" out/all.bvh --scene pit.obj --scene-unit 0.5
claim "eval: a mesh in the table" grep -Eq "^  scene +floor and 1 shape, 0 soft, 0 moving$" stdout.txt
run 0 eval "$data/walker.bvh" out/all.bvh --with brief.bvh
says "brief.bvh ends at 0.158 s"
run 3 eval "$data/walker.bvh" out/all.bvh --with no_such.bvh
silent
run 3 eval "$data/walker.bvh" out/all.bvh --scene no_such.obj
says "no_such\.obj"
for file in gym.json pit.obj beside.bvh; do
  cp $file kept
  run 2 eval "$data/walker.bvh" out/all.bvh --scene gym.json --with beside.bvh --json $file
  says "$file' is read by this run"
  claim "$file is as it was" cmp kept $file
done

keys="mpjpe_m penetration_events penetration_max_m angular_momentum_change angular_momentum_drift
  slip_m slip_m_per_s validity residual_force_ratio residual_moment_ratio momentum_balance
  correction_force_ratio ms_per_frame mpjpe_normalized_m constants newton timing floor clip
  unexplained_frames"
hierarchy() {
  sed '/^Frame Time/q' "$1"
}
for method in sdf track; do
  option=
  [ $method = track ] && option="--forces out/f.csv"
  # shellcheck disable=SC2086
  run 0 correct "$walk" -o out/a.bvh --method $method --json out/a.json $option
  claim "$method: the table has both columns" grep -Eq "capture +output" stdout.txt
  claim "$method: no progress when stderr is no terminal" test ! -s stderr.txt
  claim "$method: the report is JSON" "$json_get" out/a.json
  for key in $keys; do
    claim "$method: key $key" "$json_get" out/a.json "$key"
  done
  for key in penetration_max_m slip_m slip_m_per_s validity momentum_balance; do
    claim "$method: capture $key" "$json_get" out/a.json capture.$key
  done
  claim "$method: no penetration" awk "BEGIN {exit !($("$json_get" out/a.json penetration_max_m) <= 1e-5)}"
  claim "$method: 48 frames" test "$("$json_get" out/a.json frames.frame.47)" = 47
  claim "$method: no more" test "$("$json_get" out/a.json frames.mpjpe_m.48 || echo none)" = none
  claim "$method: 23 joints" test "$("$json_get" out/a.json joints.name.0)" = '"pelvis"'
  claim "$method: a distance for the last" "$json_get" out/a.json joints.mpjpe_m.22
  hierarchy "$walk" | tr -s ' \t\r' ' ' | sed 's/^ //; s/ $//' >h1.txt
  hierarchy out/a.bvh | tr -s ' \t\r' ' ' | sed 's/^ //; s/ $//' >h2.txt
  claim "$method: same joints, channels, frame count and frame time" \
    test "$(grep -cE 'ROOT|JOINT|CHANNELS|Frames' h1.txt)" -eq "$(grep -cE 'ROOT|JOINT|CHANNELS|Frames' h2.txt)"
  grep -E 'ROOT|JOINT|CHANNELS|Frame' h1.txt >g1.txt
  grep -E 'ROOT|JOINT|CHANNELS|Frame' h2.txt >g2.txt
  claim "$method: in the same order" cmp -s g1.txt g2.txt
  # shellcheck disable=SC2086
  run 0 correct "$walk" -o out/b.bvh --method $method --threads 2 --quiet
  claim "$method: same bytes for 2 threads" cmp -s out/a.bvh out/b.bvh
  run 0 eval "$walk" out/a.bvh --json out/e.json
  for key in mpjpe_m penetration_max_m slip_m validity momentum_balance; do
    claim "$method: eval agrees with the report on $key" \
      test "$("$json_get" out/e.json $key)" = "$("$json_get" out/a.json $key)"
  done
done
claim "track: forces have one line per frame and a header" test "$(wc -l <out/f.csv)" -eq 49
claim "forces: same number of fields everywhere" \
  awk -F, 'NR == 1 {n = NF} NF != n {exit 1}' out/f.csv
# shellcheck disable=SC2016 # the dollars are awk's
claim "forces: units in every column but the frame" \
  awk -F, 'NR == 1 {for (i = 1; i <= NF; i++) if ($i != "frame" && $i !~ /_(s|N|m|Nm)$/) exit 1}' out/f.csv
# shellcheck disable=SC2016 # the dollars are awk's
claim "forces: both feet carry the weight of one who stands, and residual and feet add up" \
  awk -F, 'NR == 1 {for (i = 1; i <= NF; i++) c[$i] = i; next}
    {l += $c["left_grf_y_N"]; r += $c["right_grf_y_N"]; x += $c["residual_force_y_N"]}
    END {n = NR - 1; w = 70 * 9.8
      exit !(l / n > 0.3 * w && r / n > 0.3 * w && (l + r + x) / n > 0.98 * w && (l + r + x) / n < 1.02 * w)}' out/f.csv
# shellcheck disable=SC2016
claim "forces: each foot is pressed on its own side" \
  awk -F, 'NR == 1 {for (i = 1; i <= NF; i++) c[$i] = i; next}
    $c["left_cop_x_m"] <= 0 || $c["right_cop_x_m"] >= 0 {exit 1}' out/f.csv
claim "forces: no nan" sh -c '! grep -qi -e nan -e inf out/f.csv'
run 0 correct "$walk" -o out/low.bvh --method sdf --floor 0.08 --json out/low.json
claim "sdf: the capture was below this floor" \
  awk "BEGIN {exit !($("$json_get" out/low.json capture.penetration_max_m) > 0.005)}"
claim "sdf: the output is not" \
  awk "BEGIN {exit !($("$json_get" out/low.json penetration_max_m) <= 1e-5)}"
claim "sdf: it was moved, but not far" \
  awk "BEGIN {m = $("$json_get" out/low.json mpjpe_m); exit !(m > 1e-4 && m < 0.02)}"
run 0 correct "$walk" -o out/a.bvh --method sdf --json -
cp stdout.txt out/a.json
claim "--json - is JSON and nothing else" "$json_get" out/a.json
claim "a kinematic method has no residual" test "$("$json_get" out/a.json residual_force_ratio)" = null
run 0 correct "$walk" -o out/a.bvh --method sdf --progress json
claim "progress is JSON lines" sh -c 'head -1 stderr.txt >line.json'
claim "each an object" "$json_get" line.json share
run 0 correct "$walk" -o out/a.bvh --method sdf --progress json --quiet
claim "--quiet is quiet" test ! -s stderr.txt
cp "$walk" out/self.bvh
run 0 correct out/self.bvh -o out/self.bvh --method sdf
ln -s self.bvh out/link.bvh
run 0 correct "$walk" -o out/link.bvh --method sdf
claim "a symbolic link stays one" test -L out/link.bvh
printf 'v -9 -1 -9\nv 9 -1 -9\nv 9 -1 9\nv -9 -1 9\nv 0 -2 0\nf 1 4 3 2\nf 1 2 5\nf 2 3 5\nf 3 4 5\nf 4 1 5\n' >deep.obj
run 0 correct "$walk" -o out/s.bvh --method sdf --scene deep.obj --scene-unit 1 --quiet
if script -qec true /dev/null >/dev/null 2>&1; then
  TERM=xterm script -qec "'$kinegrad' correct '$walk' -o out/a.bvh --method track" /dev/null >tty.txt
  claim "a terminal gets a progress line" grep -q "frames  .* fps  ETA" tty.txt
else
  echo "skipped: the progress line, there is no pseudo-terminal here"
fi

# answer is no: falling in the air where nothing can carry the body
run 1 correct "$walk" -o out/no.bvh --floor -3 --json out/no.json
claim "the frames are named" grep -Eq "external support missing in frames [0-9]+" stderr.txt
claim "the file is written all the same" test -s out/no.bvh
claim "the report has the ranges" "$json_get" out/no.json unexplained_frames.0.1

# a floor one metre up: the body is lifted out of it, which is no correction of this capture
run 1 correct "$walk" -o out/far.bvh --method sdf --floor 1 --json out/far.json
says "the output leaves the capture by more than 0.5 m in frames 0-47; out/far.bvh was written"
claim "the report says the same" awk "BEGIN {exit !($("$json_get" out/far.json mpjpe_m) > 0.5)}"
run 1 correct "$walk" -o out/far.bvh --method sdf --floor 0.55 --quiet
says "the output is 0\.[34][0-9] m from the capture in the mean"
rm -f out/far.bvh out/far.json

# steps of 0.1 s under ten times the weight: the simulation does not survive
run 1 correct "$walk" -o out/lost.bvh --dt 0.1 --gravity 100 --json out/lost.json
lost=$("$json_get" out/lost.json restart_frames.0)
claim "the frames are named as in the report" \
  grep -Eq "set back to the reference in (frame ${lost}|frames ${lost}[-,][^;]*);" stderr.txt
rm -f out/lost.bvh out/lost.json

# residual in newtons, over weight and over the peak: one number three times
"$kinegrad" correct "$walk" -o out/a.bvh --mass 60 --gravity 10 --json out/a.json >/dev/null
claim "residual over weight" awk "BEGIN {n = $("$json_get" out/a.json residual_force_rms_N)
  w = n / 600 - $("$json_get" out/a.json residual_force_over_weight)
  p = n - $("$json_get" out/a.json residual_force_ratio) * $("$json_get" out/a.json peak_grf_N)
  exit !(n > 0 && w * w < 1e-18 && p * p < 1e-18 * n * n)}"

# ---- bench ---------------------------------------------------------------------------------------

if "$kinegrad" bench -h >/dev/null 2>&1; then
  run 2 bench sofa
  says "unknown suite 'sofa'; there is: autodiff"
  run 2 bench autodiff autodiff
  says "takes one suite or none, 2 given"
  run 2 bench --rounds 0
  says "--rounds: 0 is out of range"
  run 2 bench --filter no_such_case
  says "no case has 'no_such_case' in its name"
  run 3 bench --filter ba1 --data no_such_folder
  says "no_such_folder/ba1\.txt: cannot be opened"
  mkdir -p bad/adbench
  printf '2 3 4\n1 2 3 4 5 6 7 8 9 10 11\n12 x 14\n' >bad/adbench/ba1.txt
  printf '10 25\n' >bad/adbench/gmm_d10_K25.txt
  run 3 bench --filter ba1 --data bad/adbench --json out/ratios.json
  says "^kinegrad: bad/adbench/ba1\.txt:3:4: found 'x', expected a coordinate of the point"
  run 3 bench --filter gmm_d10 --data bad/adbench
  says "gmm_d10_K25\.txt:2:1: found the end of the file, expected the number of points n"
  silent
  run 4 bench --filter mlp --json no_such_folder/x.json
  printf '2 3 8\n-0.8 -1.1 -0.8 35 40 54 420 6 -8 0.09 0.003\n7 0.5 3\n0.4\n270 830\n' >bad/adbench/ba1.txt
  run 0 bench autodiff --filter ba1 --data bad/adbench --rounds 1 --json ratios.json
  claim "bench: where the data come from" grep -q "^ba1_loss: bad/adbench/ba1\.txt, perturbed" stdout.txt
  claim "bench: compiler and flags" grep -Eq "^plain C  .*-O3.* -ffp-contract=fast" stdout.txt
  run 0 bench --help
  claim "bench: where data come from unless told" grep -q "default: \.\./shared/adbench" stdout.txt
  run 0 bench --filter mlp_relu --rounds 1 --json alone.json
  claim "bench: a time beside no other's" grep -Eq '"name": "mlp_relu recorded", "value": [0-9.e-]+, "unit": "ms", "peer": null, "peer_value": null, "ratio": null, "agreement": [0-9.e-]+' alone.json
  run 0 bench autodiff --filter ba1 --data bad/adbench --rounds 1 --json ratios.json
  claim "bench: a denominator in milliseconds" grep -Eq "plain loss, -O3 +[0-9.e-]+ +[0-9.e-]+ .* 1 x" stdout.txt
  if grep -q "not here" stdout.txt; then
    echo "skipped: ratios of bench, a peer is not in this build"
  else
    for key in name value unit peer peer_value ratio agreement; do
      claim "bench: key $key" "$json_get" ratios.json cases.0.$key
    done
    claim "bench: the answers agree" \
      awk "BEGIN {exit !($("$json_get" ratios.json cases.0.agreement) <= 1e-10)}"
    claim "bench: the ratio is that of the two times" awk "BEGIN {
      r = $("$json_get" ratios.json cases.0.value) / $("$json_get" ratios.json cases.0.peer_value)
      d = r / $("$json_get" ratios.json cases.0.ratio) - 1; exit !(d * d < 1e-20)}"
  fi
  run 0 bench dynamics --filter rnea_23 --rounds 1 --data "$data/walker.bvh" --json rnea.json
  claim "bench: a clip's own skeleton" grep -q "^rnea_23: .*walker\.bvh, 23 segments, 72 degrees" stdout.txt
  claim "bench: inverse dynamics agree" \
    awk "BEGIN {exit !($("$json_get" rnea.json cases.0.agreement) <= 1e-10)}"
  run 0 bench dynamics --filter rnea_37 --rounds 1
  claim "bench: a skeleton of its own" \
    grep -q "^rnea_37: synthetic skeleton, every joint kept, 37 segments, 114 degrees" stdout.txt
  run 0 bench step --filter step_flight --rounds 1
  claim "bench: a step beside MuJoCo, or why not" grep -Eq "MuJoCo, implicit +([0-9.]+|not here)" stdout.txt
  run 3 bench step --data no_such_folder
  says "no_such_folder: cannot be opened"
else
  echo "skipped: bench is not in this build"
fi

# ---- documents keep up ---------------------------------------------------------------------------

# shellcheck disable=SC2016 # patterns
guide=$data/../../docs/guide/read-the-report.md
sed -n 's/^ "\([^"]*\)":.*/\1/p' out/no.json | grep -vE '^(schema|kinegrad|command|method|output)$' >keys.txt
claim "the report has keys" test "$(wc -l <keys.txt)" -ge 30
while read -r key; do
  claim "the guide explains $key" grep -q "\`$key\`" "$guide"
done <keys.txt
# shellcheck disable=SC2016 # a pattern
sed -n 's/^ *X(\(KG_[A-Z_]*\), \(-*[0-9]*\), "\(.*\)").*/| `\1` | \2 | \3 |/p' \
  "$data/../../include/kinegrad/base.h" >statuses.txt
claim "status codes were found" test "$(wc -l <statuses.txt)" -ge 8
while read -r row; do
  claim "docs/errors.md has $row" grep -qF "$row" "$data/../../docs/errors.md"
done <statuses.txt


# ---- interruption: 130, nothing left -------------------------------------------------------------

rm -rf out
mkdir out
awk -v n=40 '/^Frames:/ {print "Frames: " $2 * n; next} /^Frame Time/ {print; data = 1; next}
  !data {print} data {row[++k] = $0}
  END {for (r = 0; r < n; r++) for (i = 1; i <= k; i++) print row[r % 2 ? k + 1 - i : i]}' \
  "$walk" >long.bvh
"$kinegrad" correct long.bvh -o out/x.bvh --json out/x.json --progress json >stdout.txt 2>stderr.txt &
pid=$!
for _ in 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20; do
  grep -q share stderr.txt && break
  sleep 0.1
done
kill -INT $pid
wait $pid
code=$?
claim "interrupted: exit code $code" test $code -eq 130
claim "interrupted: said so" grep -q "interrupted; nothing was written" stderr.txt
silent
nothing_in out

# ---- gradcheck -------------------------------------------------------------------------------------

run 0 gradcheck --points 5 --json out/g.json
claim "gradcheck: the report is JSON" "$json_get" out/g.json checks.0.name checks.0.passed
claim "gradcheck: a heading, a row for each check, a sum" \
  test "$(grep -c '  ok$' stdout.txt)" -eq "$(grep -o '"name"' out/g.json | wc -l)"
claim "gradcheck: the sum is said" grep -Eq "^([0-9]+) of \1 passed$" stdout.txt
for name in add matmul rotation_log "implicit primitive" checkpoint "contact force" "penetration loss" \
  inverse_dynamics "implicit_step in contact" dynamics_loss; do
  claim "gradcheck checks $name" grep -q "^$name  " stdout.txt
done
for key in name max_relative_error dot_test taylor_order passed; do
  claim "gradcheck --json has $key" grep -q "\"$key\"" out/g.json
done
claim "gradcheck: an exact remainder is null" grep -q '"taylor_order": null' out/g.json
run 0 gradcheck --points 5 --json out/h.json
claim "gradcheck: the same seed gives the same bytes" cmp -s out/g.json out/h.json
run 0 gradcheck --points 5 --seed 2 --json out/h.json
claim "gradcheck: another seed gives other points" sh -c '! cmp -s out/g.json out/h.json'
run 0 gradcheck --points 5 --filter MATMUL,step "$walk"
claim "gradcheck: a filter of two words" test "$(grep -c '  ok$' stdout.txt)" -eq 6
run 0 gradcheck --points 5 --filter ,matmul,,step, "$walk"
claim "gradcheck: stray commas mean nothing" test "$(grep -c '  ok$' stdout.txt)" -eq 6
run 0 gradcheck --points 5 --filter sin --json -
claim "gradcheck --json - is JSON alone" test "$(head -c 1 stdout.txt)" = "{"
rm -f out/g.json out/h.json

# ---- eval of two folders -------------------------------------------------------------------------

mkdir -p captures corrected
cp "$walk" captures/one.bvh
cp "$walk" captures/two.bvh
cp "$walk" corrected/one.bvh
run 1 eval captures corrected --json folders.json
says "captures/two\.bvh: no output of this clip in corrected"
claim "folders: mean of nothing changed" test "$("$json_get" folders.json mpjpe_m)" = 0.0
claim "folders: one clip" test "$("$json_get" folders.json clip_count)" = 1
claim "folders: what is missing" test "$("$json_get" folders.json missing.0)" = '"captures/two.bvh"'
claim "folders: nothing else is" test "$("$json_get" folders.json missing.1 || echo none)" = none
claim "folders: the pair" "$json_get" folders.json clips.0.capture.slip_m
cp "$walk" corrected/two.bvh
run 0 eval captures corrected
claim "eval: names of columns are whole" grep -q " angular_momentum_change " stdout.txt
claim "folders: a row for each and the mean" test "$(grep -cE '^(one|two|mean)' stdout.txt)" -eq 3
run 0 eval captures corrected --self --scene wall.json --json folders.json
claim "folders: what is in the way of all" test "$("$json_get" folders.json clips.1.scene.shape_count)" = 2
claim "folders: the mean depth in itself" "$json_get" folders.json self_penetration_mean_m
run 2 eval captures corrected --with beside.bvh
says "with has no meaning with two folders"
mkdir -p nothing
run 3 eval nothing corrected
says "no clip"
head -n $((first + 20)) "$walk" | sed 's/^Frames:.*/Frames: 21/' >short.bvh
run 3 eval "$walk" short.bvh
says "short\.bvh: .*frame"

echo "$claims claims, $failures failed"
[ $failures -eq 0 ]
