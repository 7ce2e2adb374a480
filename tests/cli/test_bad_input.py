# SPDX-License-Identifier: Apache-2.0
"""Bad input gives exit code 1 and one sentence on standard error; nothing is written."""

import json
from pathlib import Path

import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.io.robot.robot_file import find_robot_file
from loopcal.mechanism.families.placement import AngleTolerance, LengthTolerance, standard_deviation
from loopcal.mechanism.families.records import Workspace

ROBOT = find_robot_file("hexapod-42").read_text()
PROFILE = Path("examples/exports/cmm-spheres.yaml").read_text("utf-8")
EXAMPLE = Path("examples/hexapod-42")
HEADER = "pose,q1 [mm],q2 [mm],q3 [mm],q4 [mm],q5 [mm],q6 [mm],z [mm]"
DATA = f"""# kind: component
# components: [z]
# noise: {{z: 1 um}}
{HEADER}
a,0,0,0,0,0,0,200
b,1,1,1,1,1,1,201.1
c,2,2,2,2,2,2,202.2
"""
BASE = "[120, -140, 0]"
UNITS = "units: {length: mm, angle: deg}\n"


@pytest.fixture
def run_refused(loopcal, folder):
    """Run a command line with the given files; return the message with which it is refused."""

    def run(words: str, **files: str | bytes | None) -> str:
        for name, content in files.items():
            path = folder / name.replace("_", ".")
            if content is None:
                path.mkdir()
            else:
                path.write_bytes(content.encode() if isinstance(content, str) else content)
        before = sorted(p.name for p in folder.rglob("*"))
        err = loopcal(words, code=1).err
        assert err.startswith("loopcal: ")
        assert err.count("\n") == 1 + err.count("\nHint: ") <= 2
        assert "Traceback" not in err
        assert sorted(p.name for p in folder.rglob("*")) == before, "something was written"
        return err

    return run


ROBOT_CASES = [
    (UNITS, "", "has no units, which every number needs; write for example"),
    ("length: mm", "length: deg", "'units.length' is 'deg'. Allowed: 'm', 'mm'"),
    ("stroke:", "strok:", "unknown key 'strok' (did you mean 'stroke'?)"),
    (UNITS, UNITS * 2, "duplicate key 'units'. Remove one"),
    (BASE, "[120, '-140', 0]", "is the text '-140', but must be a number"),
    (BASE, "[120, -140]", "has 2 values, but must have 3. Add the missing ones"),
    (BASE, "[120, .nan, 0]", "is nan. Write a finite number"),
    ("lengths: 233.238076", "lengths: 233,238", "Write a decimal point, not a comma"),
    ("[-75, 75]", "[-75, 75, 3]", "'stroke' has 3 values, but must have 2. Remove the others"),
    (BASE, "[120, -140, 0", "not valid YAML"),
    ("format: 1", "format: 2", "has format 2, but this loopcal reads formats up to 1"),
    ("family: gough", "family: gouhg", "is not a family of robots (did you mean 'gough'?)"),
]


@pytest.mark.parametrize(("old", "new", "sentence"), ROBOT_CASES)
def test_invalid_robot_file_is_refused_with_its_line(run_refused, old, new, sentence) -> None:
    assert old in ROBOT
    found = run_refused("check robot.yaml", robot_yaml=ROBOT.replace(old, new, 1))
    assert sentence in found
    assert found.startswith("loopcal: robot.yaml:")


def test_freedom_without_actuator_is_named(run_refused) -> None:
    """All base centers are one point, so the platform can rotate about it with locked legs."""
    lines = ROBOT.split("\n")
    start, end = lines.index("base:"), lines.index("platform:")
    text = "\n".join([*lines[: start + 1], *["  - [0, 0, 0]"] * 6, *lines[end:]])
    text = text.replace("lengths: 233.238076", "lengths: 234.07")
    found = run_refused("check robot.yaml", robot_yaml=text)
    assert "the platform can move with every actuator locked" in found
    assert "rotation about" in found


def test_missing_freedom_is_named(run_refused) -> None:
    """A second limb that only slides along x prevents the motion along y."""
    limbs = [
        "  - name: a\n    ending: rigid\n    errors: [{of: s, shift: [y]}]",
        (
            "    chain: [{joint: P, name: s, axis: x, actuated: q1}, {joint: P, name: t, axis: y, "
            "actuated: q2}]"
        ),
        "  - {name: b, ending: rigid, chain: [{joint: P, name: s, axis: x}]}",
    ]
    head = [
        "format: 1",
        "family: limbs",
        "name: locked",
        UNITS.strip(),
        "freedoms: [x, y]",
        "controlled: [x, y]",
        "limbs:",
    ]
    found = run_refused("check robot.yaml", robot_yaml="\n".join([*head, *limbs]))
    assert "2 actuators" in found
    assert "only 1 of 2 freedoms" in found
    assert "translation along y" in found


def test_home_pose_outside_the_strokes_gives_a_warning(loopcal, tmp_path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(ROBOT.replace("lengths: 233.238076", "lengths: 500"))
    loopcal(f"check {path}", "warning The home pose exceeds stroke of q1, stroke of q2")


FILE_CASES = [
    (b"", "is empty"),
    (b" \n\n", "is empty"),
    (None, "is a folder. Name the"),
    ("# Länge\n".encode("latin-1"), "is not UTF-8 text (byte 0xe4). Save it as UTF-8"),
    (b"format: 1\0\n", "contains a zero byte"),
]


@pytest.mark.parametrize(("content", "sentence"), FILE_CASES)
def test_file_that_is_not_text_is_refused_as_robot_and_as_data(
    run_refused, content, sentence
) -> None:
    assert sentence in run_refused("check robot.yaml", robot_yaml=content)
    assert sentence in run_refused("calibrate hexapod-42 data.csv -o run", data_csv=content)


def test_missing_file_is_refused(run_refused) -> None:
    assert "this robot file does not exist" in run_refused("check robot.yaml")
    assert "this measurement file does not exist" in run_refused(
        "calibrate hexapod-42 data.csv -o run"
    )
    assert "this run folder does not exist" in run_refused("validate run data.csv", data_csv=DATA)


DATA_CASES = [
    ("z [mm]", "z", "data.csv:4: column 'z' has no unit. Write it in brackets, such as 'z [mm]'"),
    ("z [mm]", "z [mmm]", "data.csv:4: column 'z': unknown unit 'mmm' (did you mean 'mm'?)"),
    ("q1 [mm]", "qq1 [mm]", "data.csv:4: column 'qq1' is unknown (did you mean 'q1'?"),
    ("# noise", "# nois", "data.csv:3: unknown key 'nois' (did you mean 'noise'?)"),
    ("# noise", "# kind: pose\n# noise", "data.csv:3: duplicate key 'kind'"),
    ("q2 [mm]", "q1 [mm]", "data.csv:4: duplicate column 'q1'"),
    ("b,1,", "b,one,", "data.csv:6: column 'q1' is 'one', but must be a number"),
    ("b,1,", "b,", "data.csv:6: this row has 7 cells, but the header has 8 columns"),
    ("201.1", "NaN", "data.csv:6: column 'z' is 'NaN', which is not finite"),
    ("b,1,", "b,80,", "data.csv:6): q1 reads 80 mm, 5 mm outside its stroke of -75 to 75 mm"),
    ("# noise: {z: 1 um}\n", "", "the noise of 'z' is missing"),
    ("1 um", "1", "'1' has no unit. Add one of m, mm"),
    ("201.1", "201,1", "data.csv:6: this row has 9 cells"),
    ("# noise", "# controller: no.yaml\n# noise", "data.csv:3: 'controller' needs commanded"),
]


@pytest.mark.parametrize(
    "command", ["calibrate hexapod-42 data.csv -o run", "identifiability hexapod-42 data.csv"]
)
@pytest.mark.parametrize(("old", "new", "sentence"), DATA_CASES)
def test_invalid_measurement_file_is_refused_with_its_line(
    run_refused, old, new, sentence, command
) -> None:
    assert sentence in run_refused(command, data_csv=DATA.replace(old, new, 1))


POSES = "\n".join(line.rpartition(",")[0] for line in DATA.split("\n")[3:-1])
HEIGHTS = "# kind: component\n# components: [z]\n# noise: {z: 1 um}\npose,z [mm]\na,200\nb,201.1\n"
SEVERAL_CASES = [
    (POSES, HEIGHTS + "d,203\n", "heights.csv:7: unknown pose 'd'"),
    (
        POSES,
        DATA.replace("b,1,1", "b,1,2"),
        "heights.csv:6: pose 'b' has other readings here than in poses.csv:3",
    ),
    (POSES, HEIGHTS.split("\n", 3)[3], "heights.csv:1: column 'z' is unknown"),
    (POSES.replace("q2 [mm]", "q2 [deg]"), HEIGHTS, "poses.csv:1: column 'q2': 'deg' is a unit"),
    ("", HEIGHTS, "poses.csv: this measurement file is empty"),
    (POSES.replace("b,1,1,1,1,1,1", "b,,,,,,"), HEIGHTS, "poses.csv:3: pose 'b' has no readings"),
]


@pytest.mark.parametrize(
    "command",
    ["calibrate hexapod-42 {} -o run", "identifiability hexapod-42 {}", "validate hexapod-42 {}"],
)
@pytest.mark.parametrize(("poses", "heights", "sentence"), SEVERAL_CASES)
def test_inconsistent_files_are_refused_by_every_command(
    run_refused, poses, heights, sentence, command
) -> None:
    assert sentence in run_refused(
        command.format("poses.csv heights.csv"), poses_csv=poses, heights_csv=heights
    )


def test_export_without_a_line_that_matches_the_profile_is_refused(run_refused) -> None:
    files = {
        "cmm_yaml": PROFILE,
        "export_txt": "Kugel;X;Y;Z;Ø\nA1;1,0;2,0;3,0;25\n".encode("latin-1"),
    }
    found = run_refused("import export.txt --profile cmm.yaml -o data.csv", **files)
    assert (
        "export.txt:2: no line of this export fits cmm.yaml; reason for the first one: the name "
        "'A1' "
        "does not match K_" in found
    )


def test_too_few_equations_for_least_squares_are_refused_with_both_counts(run_refused) -> None:
    found = run_refused("calibrate hexapod-42 data.csv -o run --method ls", data_csv=DATA)
    assert (
        "3 equations from 3 poses cannot determine 42 parameters. Measure more poses like these "
        "(at least 42" in found
    )


def test_too_few_equations_are_refused_by_default_with_a_hint_to_method_map(run_refused) -> None:
    found = run_refused("calibrate hexapod-42 data.csv -o run", data_csv=DATA)
    assert "3 equations cannot determine 42 parameters" in found
    assert "Hint: use --method map" in found


@pytest.mark.slow
@pytest.mark.parametrize("kind", sorted(lc.KINDS))
def test_every_kind_is_calibrated_or_refused_with_a_message(
    tmp_path, monkeypatch, capsys, kind
) -> None:
    monkeypatch.chdir(tmp_path)
    can_measure = kind != "closure"  # a hexapod has no redundant actuator
    assert main(["simulate", "hexapod-42", "--kind", kind, "-o", "data.csv"]) == 1 - can_measure
    err = capsys.readouterr().err
    assert ("6 actuators for 6 degrees of freedom" in err) != can_measure
    code = main(["calibrate", "hexapod-42", "data.csv", "-o", "run", "--method", "map"])
    err = capsys.readouterr().err
    assert code in (0, 1, 2)
    assert (code == 0) == (err == "")
    assert all(line.startswith("loopcal: ") for line in err.splitlines())


def test_byte_order_mark_is_accepted(loopcal, tmp_path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_bytes(b"\xef\xbb\xbf" + ROBOT.encode())
    assert loopcal(f"check {path}").err == ""
    data = tmp_path / "data.csv"
    data.write_bytes(b"\xef\xbb\xbf" + DATA.encode())
    loopcal(f"identifiability {path} {data}")


USAGE_CASES = [
    ("calibrat hexapod-42", "'calibrat' is not a command (did you mean 'calibrate'"),
    ("check hexapod-42 --jsn", "No such option"),
    ("check", "Missing argument 'ROBOT'"),
    ("calibrate hexapod-42 d.csv -o r --limit-position 0.1", "'0.1' has no unit. Add one of m"),
    ("calibrate hexapod-42 d.csv -o r --limit-angle 1mm", "'mm' is a unit of length"),
    ("calibrate hexapod-42 robot.yaml -o r", "robot.yaml is a YAML file"),
    ("plan hexapod-42 -o p --like r.yaml", "r.yaml is a YAML file"),
    ("export run -o run.txt", "reprap, linuxcnc, linuxcnc-ini, urdf"),
    ("calibrate hexapod-42 d.csv -o r --hold-out 1", "--hold-out"),
    ("calibrate hexapod-42 d.csv -o r --method best", "--method"),
    ("simulate hexapod-42 --poses p.csv -o m.csv --seed -1", "--seed"),
]


@pytest.mark.parametrize(("words", "sentence"), USAGE_CASES)
def test_invalid_command_line_is_refused(run_refused, words, sentence) -> None:
    assert sentence in run_refused(words)


def test_folder_with_other_files_is_refused_as_run_folder(run_refused) -> None:
    Path("mine").mkdir()
    Path("mine/thesis.tex").touch()
    command = "calibrate hexapod-42 data.csv -o"
    assert "this folder is not empty" in run_refused(f"{command} mine", data_csv=DATA)
    assert "something other than a run" in run_refused(f"{command} mine --force")
    for place in (".", "..", "mine/.."):
        assert "it is the working folder" in run_refused(f"{command} {place}")
    assert "it is a mount point" in run_refused(f"{command} /proc")


def test_missing_controller_file_is_refused(run_refused) -> None:
    commanded = ",".join(
        f"commanded.{name}"
        for name in ("x [mm]", "y [mm]", "z [mm]", "roll [deg]", "pitch [deg]", "yaw [deg]")
    )
    text = DATA.replace(HEADER, f"pose,{commanded},z [mm]").replace(
        "# noise", "# controller: no.yaml\n# noise"
    )
    assert "'controller' names no.yaml, which does not exist" in run_refused(
        "calibrate hexapod-42 data.csv -o run", data_csv=text
    )


@pytest.mark.parametrize("number", [LengthTolerance(sd=-2.9e-5), LengthTolerance(limits=-2.9e-5)])
def test_invalid_tolerance_or_workspace_is_reported_with_its_unit(number) -> None:
    with pytest.raises(
        lc.MechanismError, match=r"the expected spread of base is -2.9e-05 m, but must"
    ):
        standard_deviation(number, "base")
    with pytest.raises(lc.MechanismError, match=r"the expected spread of tilt is 0 rad, but must"):
        standard_deviation(AngleTolerance(sd=0.0), "tilt")
    with pytest.raises(
        lc.MechanismError, match=r"the workspace of z runs from 0.3 m to 0.2 m; the first"
    ):
        _ = Workspace(z=(0.3, 0.2)).ranges
    with pytest.raises(
        lc.MechanismError, match=r"the workspace of yaw runs from 1 rad to -1 rad; the first"
    ):
        _ = Workspace(yaw=(1.0, -1.0)).ranges


@pytest.mark.parametrize(("stated", "noted"), [("other-robot", True), ("hexapod-42", False)])
def test_data_of_another_robot_give_a_note(tmp_path, capsys, stated, noted) -> None:
    data = tmp_path / "data.csv"
    data.write_text(f"# robot: {stated}\n{DATA}")
    for words in (
        ["identifiability", "hexapod-42", str(data)],
        ["validate", "hexapod-42", str(data)],
    ):
        main(words)
        said = f"loopcal: note: {data} names the robot 'other-robot', but"
        assert (said in capsys.readouterr().err) == noted


@pytest.mark.parametrize(
    ("words", "sentence", "hint"),
    [
        ("calibrate", "Missing argument 'ROBOT'.", "see loopcal calibrate --help"),
        ("simulate r.yaml", "Missing option '-o' / '--output'.", "see loopcal simulate --help"),
        (
            "calibrate r.yaml d.csv -o run --hold-out 1.5",
            "'--hold-out': it is 1.5, which is not a share of the poses, from 0 to below 1.",
            "see loopcal calibrate --help",
        ),
        (
            "calibrate r.yaml d.csv -o run --hold-out 25%",
            "'25%' is not a number: a share of the poses is a number from 0 to below 1",
            "see loopcal calibrate --help",
        ),
        (
            "calibrate r.yaml d.csv -o run --hold-out 10",
            "Write 0.1 for 10 %, or the number of poses to hold out divided by the number of all",
            "see loopcal calibrate --help",
        ),
        (
            "calibrate r.yaml d.csv -o run --hold-out=-0.1",
            "-0.1, which is not a share of the poses, from 0 to below 1. Write 0.25 for a quarter",
            "see loopcal calibrate --help",
        ),
        (
            "simulate r.yaml -o d.csv --sigma-position=-5um",
            "'--sigma-position': '-5um' is not above 0. Give a positive number",
            "see loopcal simulate --help",
        ),
    ],
)
def test_wrong_use_names_the_option_and_the_help(run_refused, words, sentence, hint) -> None:
    message = run_refused(words)
    assert sentence in message
    assert message.endswith(f"Hint: {hint}\n")


def test_misspelled_key_for_the_family_is_named_with_its_line(run_refused) -> None:
    message = run_refused("check r.yaml", r_yaml=f"format: 1\nfamilly: gough\n{UNITS}")
    assert "r.yaml:2: unknown key 'familly' (did you mean 'family'?). Correct it" in message


def test_missing_column_does_not_suggest_another_column_that_is_needed(run_refused) -> None:
    data = """# kind: pose
# orientation: rotation-vector
pose,q1 [mm],q2 [mm],q3 [mm],q4 [mm],q5 [mm],q6 [mm],rx [rad],ry [rad],rz [rad],x [mm],y [mm]
a,0,0,0,0,0,0,0,0,0,0,0
"""
    message = run_refused("calibrate hexapod-42 data.csv -o run", data_csv=data)
    assert "no column 'z', which the kind 'pose' measures. Add it with its unit" in message


@pytest.mark.parametrize("words", ["simulate 3-prs -o d.csv", "identifiability 3-prs"])
def test_a_pose_out_of_reach_is_named_as_in_its_file(run_refused, words) -> None:
    poses = "pose,z [mm],phi [deg],theta [deg]\nlow,700,0,10\nsteep,700,90,80\n"
    said = run_refused(f"{words} --poses p.csv", p_csv=poses)
    assert "does not reach commanded pose 'steep' at p.csv:3 (1 of 2 fail)" in said


@pytest.mark.parametrize(
    ("words", "code", "sentence"),
    [
        ("check --json", None, "Missing argument 'ROBOT'."),
        ("check no-such.yaml --json", None, "no-such.yaml: this robot file does not exist"),
        ("check hexapod-42 --json --colour", None, "--colour"),
        ("calibrate hexapod-42 still.csv --json", "workflow.too-few-equations", "equations"),
    ],
)
def test_a_refusal_under_json_is_a_document_that_says_what_standard_error_says(
    tmp_path, capsys, monkeypatch, words, code, sentence
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "still.csv").write_text(DATA)
    assert main(words.split()) == 1
    printed = capsys.readouterr()
    stated = json.loads(printed.out)["error"]
    assert sentence in stated["text"]
    assert stated["code"] == code
    assert f"loopcal: {stated['text']}\n" in printed.err
    assert (stated["hint"] is None) == ("Hint: " not in printed.err)


def test_a_defect_under_json_is_a_document_too(capsys, monkeypatch, tmp_path) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("loopcal.apply.inspection.inspect_robot", lambda _: 1 / 0)
    assert main(["check", "hexapod-42", "--json"]) == 3
    assert "this is a defect of loopcal" in json.loads(capsys.readouterr().out)["error"]["text"]
