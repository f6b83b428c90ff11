"""Command lines that are refused: each is a row of its words and a part of the one error.

Options that exclude or need each other are in test_rules.py, values out of range in test_options.py, outputs that are
inputs in test_outputs.py.
"""

from __future__ import annotations

import pytest

from tests.commands.cli import Cli

TREE = "hand-tree-v3.spz"
AT = "--look-at 0,-3,9:0,0,0"
TURN = "-1,0,0,0,0,-1,0,0,0,0,1,0,0,0,0,1"
SHARES = ",".join(f"{share}%" for share in range(60, 44, -1))
IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0 7 8 9 1"

#: Wrong usage of commands that write trees and scenes.
WRITING = [
    # Options of builders.
    ("build-lod", "Missing argument"),
    # Selection and transforms.
    ("build-lod a.ply --min-box 1,2", "x,y,z"),
    ("build-lod a.ply --max-box 1,2,nan", "x,y,z"),
    ("build-lod a.ply --within 1,2,3", "x,y,z,radius"),
    ("build-lod a.ply --within 1,2,3,-1", "radius"),
    ("build-lod a.ply -o a.spz --rotate 90", "x,y,z"),
    ("build-lod a.ply -o a.spz --scale 1e13", "the scale 1e+13 is out of range"),
    ("build-lod a.ply -o a.spz --translate 1e13,0,0", "the translation 1e+13,0,0 is out of range"),
    # Outputs and formats.
    ("build-lod a.ply b.ply -o c.spz", "add --merge to bake them as one scene, or name a folder"),
    ("build-lod x/a.ply y/a.ply --output-dir d", "two outputs would be written to d/a-lod.spz"),
    ("build-lod a.ply -o - --json", "standard output"),
    ("build-lod a.ply -o out.obj", "not as .obj; name the output .spz, .rad, lod-meta.json or"),
    ("build-lod a.ply -o out.RADC", "trees are written as SPZ, RAD, Streamed SOG or 3D Tiles, not as .radc"),
    ("build-lod a.ply -o out.spz.gz", "trees are written as SPZ, RAD, Streamed SOG or 3D Tiles, not as .gz"),
    ("build-lod a.ply -o out.ply", ".ply cannot hold a tree; name the output .spz, .rad, lod-meta.json or"),
    ("build-lod a.ply -o web/other.json", ".json cannot hold a tree; name the output .spz, .rad, lod-meta.json or"),
    ("build-lod a.ply -o out.bin", ".bin holds arrays; bake a tree, and write it with sparklod convert --layout"),
    ("build-lod a.ply -o noname", "end it in .spz, .rad, /lod-meta.json, /tileset.json, or"),
    ("build-lod a.ply --format spz -o x.rad", "--format spz writes .spz, not .rad"),
    ("build-lod a.ply --format rad -o lod-meta.json", "--format rad writes .rad, not .json"),
    ("build-lod a.ply --format rad-chunked -o x.ply", "--format rad-chunked writes .rad, not .ply"),
    ("build-lod a.ply --format rad-chunked -o -", "rad-chunked writes several files; name the output"),
    ("build-lod a.ply --format streamed-sog -o -", "streamed-sog writes several files; name the output, such as web/"),
    ("build-lod a.ply --format streamed-sog -o x.spz", "not x.spz; name the output x/lod-meta.json"),
    ("build-lod a.ply --format streamed-sog -o web", "not web; name the output web/lod-meta.json"),
    ("build-lod a.ply --format 3d-tiles -o city.json", "name the output"),
    ("build-lod -", "standard input has no name to derive one from; name the output file"),
    ("build-lod - --output-dir web", "standard input has no name to derive one from; name the output file"),
    ("build-lod - sh1.ply", "standard input has no name to derive one from; name the output file"),
    ("build-lod https://example.org/scene.ply", "nothing can be written beside https://example.org/scene.ply; name"),
    ("build-lod simplecache::http://example.org/a.ply", "nothing can be written beside simplecache::http://example"),
    # Options of Streamed SOG.
    ("build-lod a.ply -o lod-meta.json --chunk-splats 0", "'0' is out of range; give 1 or more"),
    ("build-lod a.ply -o lod-meta.json --levels ''", "'' is neither auto nor shares"),
    ("build-lod a.ply -o lod-meta.json --levels 9%,9%", "'9%,9%' is neither auto nor shares"),
    ("build-lod a.ply -o lod-meta.json --levels 2", "'2' is neither auto nor shares"),
    ("build-lod a.ply -o lod-meta.json --levels 100%", "above 0% and below 100%"),
    ("build-lod a.ply -o lod-meta.json --levels 0%", "above 0% and below 100%"),
    (f"build-lod a.ply -o lod-meta.json --levels {SHARES}", "at most 15"),
    # Options of 3D Tiles.
    ("build-lod a.ply -o tileset.json --tile-splats 0", "1 or more"),
    ("build-lod a.ply --tile-splats 50.000", "'50.000' has digits in groups; did you mean 50000 or 50k?"),
    ("build-lod a.ply -o tileset.json --transform 1,2,3", "is not 16 finite numbers"),
    ("build-lod a.ply -o tileset.json --transform '1 0 0 0 0 1 0 0 0 0 -1 0 0 0 0 1'", "flattens or mirrors"),
    ("build-lod a.ply -o tileset.json --transform '1 0 0 7 0 1 0 8 0 0 1 9 0 0 0 1'", "give it column by column"),
    # Several inputs, colours, fitting.
    ("build-lod --merge -o x.spz", "Missing argument 'INPUT...'"),
    ("build-lod a.ply --refine 0", "0 is not in the range"),
    ("build-lod a.ply --refine many", "'many' is no number; put --refine after the inputs, or write --refine=2000"),
    ("build-lod --refine a.ply", "is no number; put --refine after the inputs, or write --refine=2000"),
    # Memory, scratch and workers.
    ("build-lod a.ply --memory much", "'much' is not a size"),
    ("build-lod a.ply --memory 0B", "'0B' must be positive"),
    ("build-lod a.ply --memory 4", "'4' has no unit; write 4G or 4MB"),
    ("build-lod a.ply --memory 600000000", "'600000000' has no unit"),
    ("build-lod a.ply --scratch-dir -", "it cannot go to standard output"),
    # Options of former versions, and misspelt ones.
    ("build-lod a.spz --unlod", "there is no option --unlod any more; write sparklod convert IN OUT --leaves"),
    ("build-lod a.ply --encoding ext", "--encoding any more; write sparklod convert IN OUT.npz --layout NAME"),
    ("build-lod a.ply --quality", "there is no option --quality; did you mean --method quality?"),
    # convert
    ("convert sh1.ply", "Missing argument 'OUT'"),
    ("convert sh1.ply a.npz", ".npz holds arrays; choose their --layout: packed, ext, lodtree, texture"),
    ("convert sh1.ply web/lod-meta.json", "lod-meta.json consists of cuts of a tree; build-lod -o web/lod-meta.json"),
    ("convert sh1.ply tileset.json", "build-lod -o tileset.json makes them"),
    ("convert sh1.ply a", "OUT a has no suffix, which chooses the format"),
    ("convert sh1.ply a.ksplat", "OUT ends in .ply, .spz, .rad, .sog, meta.json, .glb, .splat, .npz, .bin, .raw, not"),
    ("convert sh1.ply a.ply --format sog", "--format sog writes .sog, not .ply"),
    ("convert sh1.ply -", "standard output has no name, which chooses the format; add --format"),
    ("convert sh1.ply - --format rad-chunked", "--format rad-chunked writes several files"),
    ("convert sh1.ply sh1.ply -f", "is an input; name another output"),
    ("convert sh1.ply ./", "OUT is a folder; name the file in it, or add --format"),
    ("convert - ./ --format sog", "standard input has no name"),
    # simplify
    ("simplify sh1.ply --to 1%", "Missing option '-o' / '--output'"),
    ("simplify sh1.ply -o x.ply", "say how many splats to keep: give one of --to, --max-bytes and --psnr"),
    ("simplify sh1.ply --to ten -o x.ply", "'ten' is neither a share such as 5% nor a count"),
    ("simplify sh1.ply --to 1% -o x.npz", "--output writes .ply"),
    ("simplify sh1.ply --to 1% -o x", "has no suffix, which chooses the format"),
    ("simplify sh1.ply --to 1% -o - --json", "cannot both go to standard output"),
    ("simplify sh1.ply - --to 1% -o x.ply", "standard input cannot be merged"),
    *(
        (f"simplify sh1.ply -o x.ply --max-bytes='{size}'", f"'{size}' is not a size: whole bytes, such as 3000000,")
        for size in ("-1", "3Mbit", "3 apples", "1.5", "3iB")
    ),
]

#: Wrong usage of commands that look at scenes.
VIEWING = [
    # Inputs and budgets.
    ("render", "a FILE is missing; name one, or an instances file with --scene"),
    ("traverse", "a FILE is missing; name one, or an instances file with --scene"),
    (f"render {TREE} --budget many", "--budget"),
    (f"traverse {TREE} --budget 0", "the budget must be from 1 to 2^53, not 0"),
    (f"traverse {TREE} --budget 1e60", "the budget must be from 1 to 2^53, not 1e60"),
    (f"traverse {TREE} --budget 0%", "a budget of 0% leaves nothing to draw"),
    (f"render {TREE} --budget 5%,10%", "--budget 5%,10% names several, which only render --compare takes"),
    (f"render {TREE} {TREE} --budget 1", "a budget of 1 splat is less than one for each of 2 instances"),
    (f"traverse {TREE} tree-v3.spz --budget 1", "a budget of 1 splat is less than one for each of 2 instances"),
    (f"traverse {TREE} --lod-splat-scale inf", "2^53, not 2500000 times --lod-splat-scale inf"),
    *(
        (f"{command} sh1-streamed-sog {TREE} {AT}", "look at one of them at a time")
        for command in ("render", "traverse", "render --compare --budget 50%")
    ),
    # Networks and loading.
    (f"traverse {TREE} --bandwidth 20", "--bandwidth"),
    (f"traverse {TREE} --bandwidth 0Mbit", "--bandwidth"),
    (f"traverse {TREE} --bandwidth 1Mbit --latency 60", "--latency"),
    (f"traverse {TREE} tree-v3.spz --chunk-cache 1", "cannot hold the roots of 2 trees"),
    (f"render {TREE} --bandwidth 1Mbit --after 1", "'1' is not a time"),
    # Cameras.
    *(
        (f"traverse {TREE} --look-at {wrong}", "Invalid value for '--look-at'")
        for wrong in ("1,2,3", "1,2,3:1,2", "1,2,3:1,2,3", "a:b", "1,2,3:4,5,nan")
    ),
    (f"traverse {TREE} --look-at 0,0,0:0,0,0", "looks at its own eye"),
    (f"render {TREE} --view 0,0,0:0,0,0", "looks at its own eye"),
    (f"traverse {TREE} --keyframes 1,2,3:4,5,6", "fewer than two keyframes"),
    (f"traverse {TREE} --up 0,0,0", "0,0,0 is no direction"),
    (f"traverse {TREE} --dolly --seconds 1e6", "more than"),
    (f"traverse {TREE} {AT} --world-transform {TURN.replace('-1', '1', 1)}", "has a matrix that mirrors"),
    (f"traverse {TREE} {AT} --world-transform {TURN.replace('-1', '-2', 1)}", "axes that are not at right angles, or"),
    (f"traverse {TREE} {AT} --world-transform {TURN[:-2]}", "has 15 numbers, not 16"),
    # Sizes of pictures.
    *(
        (f"render {TREE} --size={size}", said)
        for size, said in (
            ("100000x100000", "is too large; give at most 65,536 pixels along a side, such as 1280x720"),
            (f"8x{'9' * 5000}", "is too large"),
            ("8x65537", "is too large"),
            ("8x" + "0" * 5000, "is not a width and a height"),
            ("0x8", "'0x8' is not a width and a height in pixels, such as 1280x720"),
            *(
                (wrong, "such as 1280x720")
                for wrong in ("8", "8x", "8x-8", "-640x480", "640x4.8", "8x\u00b2", "6\u00b2x7")
            ),
            ("65536x65536", "are more than 134,217,728; give a smaller --size"),
            ("9000x9000 --supersample 2", "9,000 x 9,000 pixels x 4 (--supersample 2)"),
            ("17000x10 -o x.webp", "more than 16,383 a side"),
        )
    ),
    # Pictures.
    (f"render {TREE} --background red", "'red' is not a colour"),
    (f"render {TREE} --background '#12345'", "is not a colour"),
    *(
        (f"render {TREE} --alpha -o x{suffix}", f"{suffix} has no alpha")
        for suffix in (".gif", ".mp4", ".webm", ".jpg")
    ),
    (f"render {TREE} --near 5 --far 5", "--near 5 must be less than --far 5"),
    (f"render {TREE} --diff {TREE} --alpha", "--diff compares pictures without alpha; name a --background"),
    (f"render {TREE} -o x.tif", "--output x.tif does not end in .png, .jpg, .webp, .npy, .gif, .mp4 or .webm"),
    (f"render {TREE} --orbit 3 -o x.png", "there are 3 cameras: write frames (x.%04d.png)"),
    (f"render {TREE} --orbit 3 -o -", "standard output takes one picture, not 3"),
    (f"render {TREE} --orbit 3 -o %d.%d.png", "does not name frames"),
    (f"render {TREE} --orbit 3 -o %d.mp4", "does not name frames"),
    (f"render {TREE} --sheet -o x.npy", "a contact sheet is one .png, .jpg or .webp"),
    (f"render {TREE} --json -o -", "--output - and --json cannot both go to standard output"),
    # Comparisons.
    *(
        (f"render {TREE} --compare -o {name}", f"{name}: tables are written as .csv, .json, .parquet")
        for name in ("table.png", "table.xlsx", "table.txt")
    ),
    (f"render {TREE} --compare --plot charts.svg", "charts.svg' does not end in .png"),
    (f"render {TREE} --compare --budget 1%,100% --assert 7%:psnr>99", "7% is not one of the budgets, 1%, 100%"),
    (f"render {TREE} --compare --assert psnrr>1", "no column 'psnrr', did you mean psnr"),
    (f"render {TREE} --compare --assert churn<1", "no column 'churn'"),
    # Tables of traverse.
    (f"traverse {TREE} -o t.xlsx", "--output t.xlsx: tables are written as .csv, .json, .parquet"),
    (f"traverse {TREE} -o t.png", "--output t.png: tables are written as .csv"),
    (f"traverse {TREE} -o t.spz --format json", "t.spz does not end in .json, which --format asks for"),
    (f"traverse {TREE} --plot t.jpg", "'t.jpg' does not end in .png, which is what is written"),
    (f"traverse {TREE} -o x --plot x", "two outputs would be written to x"),
    (f"traverse {TREE} --json -o -", "--output - and --json cannot both go to standard output"),
    (f"traverse {TREE} --assert churn", "--assert 'churn' is not an assertion"),
    (f"traverse {TREE} --assert 'selectd<=4k'", "there is no column 'selectd', did you mean selected?"),
    (f"traverse {TREE} --orbit 3 --indices-out {TREE}", TREE),
]

#: Wrong usage of `inspect` and `completion`.
REPORTING = [
    ("inspect", "Missing argument"),
    ("inspect - --html ./", "standard input has no name to derive one from; name the output file"),
    (f"inspect {TREE} --histogram beauty", "--histogram: there is no quantity"),
    (f"inspect {TREE} --html page.spz", "page.spz' does not end in ."),
    *(
        (f"inspect {TREE} --assert '{text}'", said)
        for text, said in (
            ("nodes", "--assert 'nodes' is not an assertion like 'nodes<=5M'"),
            ("bytes<1 mile", "--assert 'bytes<1 mile': '1 mile' is not a number"),
            ("node<5", "there is no 'node' in a report, did you mean nodes"),
            ("tre.leaves<5", "there is no 'tre.leaves' in a report"),
        )
    ),
]

#: Habits of other programs: an output named last as by cp, blanks before units, digits in groups, other names.
HABITS = [
    *(
        (line, f"error: {line.split()[at]} does not exist; did you mean {flag} {line.split()[at].rstrip('/')}?")
        for line, flag, at in (
            ("build-lod sh0.ply out.spz", "-o", 2),
            ("build-lod sh0.ply out.rad --method quality", "-o", 2),
            ("build-lod tree-v3.spz out.spz", "-o", 2),
            ("build-lod sh0.ply out/lod-meta.json", "-o", 2),
            ("build-lod sh0.ply tree-v3.spz out.rad --merge", "-o", 3),
            ("simplify sh0.ply small.ply --to 10%", "-o", 2),
            ("simplify --to 10% sh0.ply small.sog", "-o", 4),
            ("render sh0.ply out.png", "-o", 2),
            ("traverse tree-v3.spz frames.csv", "-o", 2),
            ("inspect sh0.ply report.html", "--html", 2),
            ("inspect sh0.ply tree-v3.spz report.HTM", "--html", 3),
        )
    ),
    ("build-lod sh0.ply tree-v3.spz", "tree-v3.spz exists, so it is an input; did you mean -o tree-v3.spz?"),
    ("view sh0.ply site/", "error: site does not exist; did you mean --export site?"),
    ("simplify sh0.ply --to 10 % -o a.ply", "10 % has a blank before its unit; write 10%"),
    ("simplify sh0.ply --to=10 % -o a.ply", "--to=10 % has a blank before its unit; write --to=10%"),
    ("simplify sh0.ply --max-bytes 8 MB -o a.ply", "8 MB has a blank before its unit; write 8MB"),
    ("render sh0.ply --budget 50 k", "50 k has a blank before its unit; write 50k"),
    ("render sh0.ply --orbit 1 k -o a.png", "1 k has a blank before its unit; write 1k"),
    ("traverse sh0.ply --bandwidth 20 Mbit", "20 Mbit has a blank before its unit; write 20Mbit"),
    ("traverse sh0.ply --latency 60 ms", "60 ms has a blank before its unit; write 60ms"),
    ("render sh0.ply --budget 500.000", "'500.000' has digits in groups; did you mean 500000 or 500k?"),
    ("traverse sh0.ply --budget 250,500", "'250,500' has digits in groups; did you mean 250500?"),
    ("view sh0.ply --budget 500.000", "'500.000' has digits in groups; did you mean 500000 or 500k?"),
    ("simplify sh0.ply --to 0.5 -o a.ply", "nor a count such as 500k; did you mean 50%?"),
    ("render sh0.ply --budget .05", "nor a count such as 500k; did you mean 5%?"),
    ("build-lod --ouput x", "there is no option --ouput; did you mean --output?"),
    ("build-lod --spz-versoin 2", "there is no option --spz-versoin; did you mean --spz-version?"),
    ("inspect --chek", "there is no option --chek; did you mean --check?"),
    ("--verison", "there is no option --verison; did you mean --version?"),
    ("warmup --outside-foveate 1", "there is no option --outside-foveate; traverse, render have it"),
    ("inspect --leaves", "there is no option --leaves; convert has it"),
    ("--overwrite build-lod", "options of a command follow its name, as in sparklod build-lod --overwrite"),
    ("-q", "options of a command follow its name, as in sparklod build-lod -q"),
    ("inspect --max-bytes 9", "there is no option --max-bytes any more; write --assert 'bytes<=N'"),
    ("doctor --xyzzy", "there is no option --xyzzy"),
    ("xyzzy", "there is no command 'xyzzy'; the commands are build-lod, convert, simplify, inspect, traverse, render"),
    ("sh0.ply", "there is no command 'sh0.ply'; did you mean build-lod sh0.ply?"),
]

#: Inputs and outputs that fail before the work: the error names the file and says why.
FAILING = [
    ("build-lod missing.ply", "missing.ply: cannot be read: no such file or directory"),
    ("build-lod ./", "cannot be read: is a directory, without"),
    (f"build-lod {'n' * 250}.ply", ": file name too long"),
    (f"build-lod {'n' * 300}", ": file name too long"),
    ("build-lod sh3.ply -o a.spz --translate 1e9,0,0", "scale the scene"),
    ("build-lod sh2.ply --rgba missing.npy -o a.spz", "missing.npy cannot be read: no such file"),
    ("build-lod sh2.ply -o web/lod-meta.json --environment missing.ply", "sh2.ply: missing.ply cannot be read"),
    ("build-lod sh2.ply -o web/lod-meta.json --environment tree-v3.spz", "tree-v3.spz: it is a Level-of"),
    ("build-lod sh1.ply tree-v3.spz --merge -o x.spz", "tree-v3.spz: it is a Level-of-Detail file already; give the"),
    *(
        (f"build-lod tree-v3.spz {options}", "it is a Level-of-Detail file already; sparklod convert writes")
        for options in ("", "--format spz", "-o out/a.spz")
    ),
    ("build-lod sh1-tree.rad -o out/a.rad", "it is a Level-of-Detail file already; sparklod convert writes its tree"),
    ("build-lod sh3-rad/sh3.rad --output-dir out --format rad-chunked", "it is a Level-of-Detail file already"),
    *(
        (f"build-lod tree-v3.spz -o {output} {option}", f"it has a tree, which is written as it is; leave out {name}, ")
        for output, option in (
            *(("a.rad", option) for option in ("--base 1.5", "--max-sh 3", "--up -y", "--within 0,0,0,1")),
            *(("a.rad", "--method quick"), ("lod-meta.json", "--method quality"), ("lod-meta.json", "--growth 1.4")),
            *(("lod-meta.json", "--environment-beyond 9"), ("lod-meta.json", "--up -y")),
        )
        for name in option.split()[:1]
    ),
    (f"convert {TREE} a.spz --up -y", "it has a tree, which is written as it is; leave out --up, or"),
    ("convert sh1.ply a.spz --leaves", "it has no Level-of-Detail tree whose leaves could be written"),
    ("convert sh1.ply a.npz --layout lodtree", "it has no tree, which the layout lodtree consists of; build-lod makes"),
    (f"simplify {TREE} --to 200 --min-opacity 0.1 -o a.ply", "leave out --min-opacity"),
    ("simplify ply-cut-header.ply --to 1k -o a.spz", "ply-cut-header.ply: the PLY header does not end"),
    ("simplify one.ply ply-cut-header.ply --to 1k -o a.spz", "ply-cut-header.ply: the PLY header does not end"),
    *(
        (f"{command} {files}", said)
        for command in ("render --size 160x90", "traverse")
        for files, said in (
            ("missing.spz", "missing.spz: cannot be read: no such file"),
            (f"{TREE} missing.spz", "missing.spz: cannot be read: no such file"),
            ("spz-flipped-bit.spz", "spz-flipped-bit.spz: corrupt gzip data"),
            ("tree-cycle.spz", "tree-cycle.spz: its tree is broken"),
            (f"{TREE} --camera-path no.json", "no.json cannot be read: no such file"),
            (f"{TREE} --camera-path {TREE}", f"{TREE}: its content is of no known format"),
            (f"{TREE} --camera-path ./", "is a directory, without images.bin and cameras.bin, or images.txt"),
            (f"{TREE} --camera-path /dev/null", "it is a pipe or a device"),
            (f"{TREE} {AT} --world-transform no.json", "no.json cannot be read"),
            ("--scene no.json", "no.json cannot be read: no such file"),
            ("--scene inria.json", "inria.json: it has no list of instances"),
        )
    ),
    (f"render {TREE} --diff missing.spz", "missing.spz: cannot be read: no such file"),
    ("render no-splats.ply", "it has no splats"),
    ("render sh2.ply --color-by level", "no file is a Level-of-Detail tree"),
    (f"render {TREE} -o {TREE}/out.png", f"{TREE} is a file, not a folder"),
    (f"traverse {TREE} -o {TREE}/out.csv", f"{TREE} is a file, not a folder"),
    (f"inspect {TREE} --html {TREE}/", f"{TREE} is a file, not a folder"),
    ("traverse sh2.ply", "bake it first with sparklod build-lod"),
    (f"traverse {TREE} --assert 'first_picture_s<1'", "first_picture_s is empty: it needs --bandwidth"),
    (f"traverse {TREE} --assert 'complete_in_s<1' -o a.csv", "complete_in_s is empty: it needs --bandwidth"),
    ("render town.spz --size 64x48 --look-at 0,-3,9:0,-3,18 --compare -o a.csv", "covers no pixel, so there is"),
    ("render town.spz --size 64x48 --look-at 0,-3,9:0,-3,18 --diff town.spz -o a.png", "covers no pixel, so there is"),
    ("render town.spz --size 64x48 --look-at 0,-3,9:0,0,0 --far 0.02 --compare -o a.csv", "covers no pixel, so there"),
    (f"inspect {TREE} --field tree.leafs", "the report has no tree.leafs"),
    (f"inspect {TREE} --html a.html --expect /dev/null", "/dev/null"),
]


@pytest.mark.parametrize(("line", "said"), [*WRITING, *VIEWING, *REPORTING, *HABITS])
def test_wrong_usage_is_exit_status_2_before_anything_is_written(line: str, said: str, cli: Cli) -> None:
    done = cli(line, status=2)
    assert said in done.words
    assert done.out == ""
    assert cli.made() == []


@pytest.mark.parametrize(("line", "said"), FAILING)
def test_a_failure_is_one_error_that_names_the_file_and_leaves_nothing(line: str, said: str, cli: Cli) -> None:
    done = cli(line, status=1)
    assert done.err.startswith("error: ") and done.err.count("\n") == 1
    assert said in done.err
    assert done.out == "" or line.startswith("traverse")  # an assertion is evaluated at the end of the table
    assert "-o" in line or cli.made() == []


def test_a_file_may_have_the_name_of_a_unit_or_of_an_output(cli: Cli) -> None:
    cli.put("k", "").unlink()
    cli.copy("sh0.ply")
    (cli.folder / "sh0.ply").rename(cli.folder / "k")
    cli("render -o a.png --size 8x8 --orbit 1 k")
    done = cli("build-lod one.ply other.spz --output-dir out", status=1)
    assert "other.spz: cannot be read" in done.err


@pytest.mark.parametrize("quiet", ["", "-q"])
@pytest.mark.parametrize(
    "line",
    [
        "simplify tree-v3.spz --to 20 -o a.ply",
        "render tree-v3.spz --budget 20 -o a.png --size 8x8",
        "traverse tree-v3.spz --budget 20 -o a.csv --orbit 2",
    ],
)
def test_a_budget_of_few_splats_is_questioned_and_used(line: str, quiet: str, cli: Cli) -> None:
    question = "20 means 20 splats; did you mean 20k or 20%?"
    assert cli(f"{line} {quiet}").err.splitlines().count(question) == (not quiet)
