# Draws the errors that error_map has written: gnuplot -e "data='FILE'; picture='FILE'" numerics-error.gp

set terminal svg size 1500,760 font 'sans-serif,13' background '#ffffff'
set output picture
set datafile separator ','
set multiplot

# Sequential, to the bound; what exceeds it is red, where no point fell is the grey of the background.
set palette defined (0 '#f7fbff', 2 '#c6dbef', 5 '#6baed6', 9 '#2171b5', 13 '#08306b', 15.99 '#08306b', 16 '#d7191c', 17 '#d7191c')
set cbrange [0:17]
unset colorbox
unset key
set tics out nomirror font ',10'
set format x '10^{%g}'
set format y '10^{%g}'
set xlabel font ',12' offset 0,0.6
set ylabel font ',12' offset 1.6,0
set title font ',13' offset 0,-0.5

set label 1 'Worst error of the value and of every slope, at random points of the whole domain' at screen 0.5,0.965 center font ',17'
set label 2 'eps = 2^{-53}  in double, 2^{-24}  in single precision; cond = sum of |p df/dp|/|f| over the parameters; grey: no point, or the result flushes to 0 or saturates' at screen 0.5,0.925 center font ',12' textcolor '#555555'

left = 0.05
step = 0.177
width = 0.13
height = 0.31
bottom(precision) = precision eq 'double' ? 0.54 : 0.11

panel(plane, precision) = sprintf("< awk -F, '$1 == \"%s\" && $2 == \"%s\" ' %s", plane, precision, data)

planes = 'phong ward lafortune he_torrance he_torrance_angles'
titles = '"Phong" "Ward" "Lafortune, one lobe" "He-Torrance" "He-Torrance, angles"'
x_labels = '"n" "α" "n" "g" "90° - θ_i  [deg]"'
y_labels = '"n |ln cos α|" "tan δ / α" "|n ln b|" "a / g" "90° - |θ_r|  [deg]"'
x_low = '-4 -4 -2 -12 -3'
x_high = '6 1 6 5 2'
y_low = '-6 -3 -6 -6 -3'
y_high = '3 1.5 3 6 2'
x_step = '2 1 2 4 1'
y_step = '3 1 3 3 1'

do for [precision in 'double single'] {
    do for [i = 1:5] {
        set lmargin at screen left + (i - 1) * step
        set rmargin at screen left + (i - 1) * step + width
        set bmargin at screen bottom(precision)
        set tmargin at screen bottom(precision) + height
        set title word(titles, i).', '.precision
        set xlabel word(x_labels, i)
        set ylabel word(y_labels, i)
        set xrange [word(x_low, i) + 0:word(x_high, i) + 0]
        set yrange [word(y_low, i) + 0:word(y_high, i) + 0]
        set xtics word(x_step, i) + 0
        set ytics word(y_step, i) + 0
        set object 1 rectangle from graph 0,0 to graph 1,1 behind fillcolor rgb '#d9d9d9' fillstyle solid noborder
        plot panel(word(planes, i), precision) using 3:4:(column(5) > 16 ? 17 : column(5)) with image
        unset label 1
        unset label 2
    }
}

# The scale alone.
unset object 1
unset title
unset xlabel
unset ylabel
unset tics
unset border
set colorbox user origin screen 0.925,0.11 size screen 0.014,0.74
set cblabel 'worst error / (eps (1 + cond))' offset 0.5,0 font ',12'
set cbtics ('0' 0, '4' 4, '8' 8, '12' 12, '16 = bound' 16) font ',11' offset -0.5,0
set lmargin at screen 0.92
set rmargin at screen 0.93
set xrange [0:1]
set yrange [0:1]
plot '+' using (-1):(-1):(0) with points palette
unset multiplot
